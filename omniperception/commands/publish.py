"""Makes a small run directory of a run's newest policy, fit for a repository.

    publish run=latest to=pretrained/mine

The folder holds weights, config.yaml, provenance.json and, where it was measured, the gait's response.json; play,
evaluate and export take it as run=<folder>, train as init=<folder>. At most 4 MB are published.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.publish import publish
from omnirobot.common.cli import Command, argument


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's arguments."""

    run: str = argument("latest", "run directory, or latest for the newest under outputs/")
    to: Path = argument(doc="folder that becomes a run directory")


def main(arguments: Arguments) -> None:
    """Publishes, and prints what the run was."""
    record = publish(config.find_run(arguments.run), arguments.to)
    print(f"{arguments.to}: {record['iterations']} iterations, {record['training_hours']} h of training")


command = Command(main, Arguments, __doc__)
