"""Lists runs, the newest last: what each was begun with, its iterations, and rates of the newest iteration.

    runs
    runs sweeps/heights

Rates are those of the training's console. A dash: the run was begun before they were kept, or has not come so far.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.common.tables import markdown
from omniperception.learning import list_checkpoints
from omniperception.learning.logger import CONSOLE_METRICS
from omniperception.learning.progress import load_progress
from omnirobot.common.cli import Command, argument


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    folder: Path = argument(config.OUTPUTS, "folder that holds runs, at any depth")


def main(arguments: Arguments) -> None:
    """Prints the table."""
    runs = config.find_runs(arguments.folder)
    if not runs:
        what = "holds no run" if arguments.folder.is_dir() else "does not exist"
        raise config.ConfigError(f"folder={arguments.folder} {what}; give a folder of run directories")
    progress = [{"rates": {}} | (load_progress(run) or {}) for run in runs]
    names = [name for name in ("reward", *CONSOLE_METRICS) if any(name in made["rates"] for made in progress)]
    rows = [
        (str(run), config.recipe(run), _iterations(run, made), *(made["rates"].get(name) for name in names))
        for run, made in zip(runs, progress, strict=True)
    ]
    print(markdown(("run", "recipe", "iterations", *names), rows))


def _iterations(run: Path, made: dict) -> str | None:
    """Completed iterations, and of how many; those of the newest checkpoint where nothing else tells."""
    if {"iterations", "total"} <= made.keys():
        return f"{made['iterations']}/{made['total']}"
    checkpoints = list_checkpoints(run)
    return checkpoints[-1].stem.removeprefix("model_") if checkpoints else None


command = Command(main, Arguments, __doc__, first="folder")
