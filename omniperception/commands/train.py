"""Trains a policy, or goes on with a run.

    train                                       # the quickstart recipe
    train experiment=walk obstacles=mixed num_envs=256
    train run=outputs/2026-01-31/12-00-00
    train -m seed=1,2 perception=pd_risknet,fps_mlp

A run's directory is outputs/<date>/<time>, or hydra.run.dir=<folder>. `run` goes on exactly where a stopped run was,
and so does a command line whose run directory holds checkpoints of the same configuration. All else is Hydra's: `-m`
runs every combination of values with commas, on a cluster with hydra/launcher=submitit_slurm, `--cfg job` prints the
composed configuration, `--hydra-help` lists the other flags.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig

from omniperception import config
from omnirobot.common.cli import Command, argument, fail, terminal, trust
from omnirobot.common.errors import UserError, one_line

HYDRAS = (
    *("-m", "--multirun", "--cfg", "-c", "--resolve", "--package", "-p", "--info", "-i", "--hydra-help"),
    *("--shell-completion", "-sc", "--experimental-rerun"),
)
"""Flags that Hydra reads."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    run: str | None = argument(None, "run directory to go on with, or latest")
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Goes on with a run, or lets Hydra start one, several, or what else its flags say."""
    values = [text for text in overrides if text.startswith("~") or (not text.startswith("-") and "=" in text)]
    flags = [text for text in overrides if text not in values]
    if arguments.run is None:
        return start(flags, values, arguments.trust)
    if flags:
        raise config.ConfigError(f"{' '.join(flags)}: a run goes on by itself; leave it out")
    run_dir = config.find_run(arguments.run)
    from omniperception import training  # brings PyTorch, without which what is wrong so far is said

    training.go_on(run_dir, values, arguments.trust)


def start(flags: Sequence[str], overrides: Sequence[str], trust: Sequence[str] = ()) -> None:
    """What Hydra makes of flags and overrides; every job is composed and assembled before the first one begins."""
    sweeps = bool({"-m", "--multirun"} & set(flags)) or "hydra.mode=MULTIRUN" in overrides
    parsed = config.parse(overrides, sweeps)
    composed = [config.compose(job) for job in config.jobs(parsed)]
    if sweeps or not flags:  # it trains
        from omniperception import training

        for one in composed:
            training.assemble(one)
    folders = config.search_path(parsed)
    texts = [str(o.input_line) for o in parsed if o.key_or_group != "hydra.searchpath"]
    remembered = f"++{config.SEARCH_PATH}=[{','.join(config.quoted(str(folder)) for folder in folders)}]"
    found = [*config.as_override(folders), remembered] if folders else []
    failed, begun = list[Path](), list[Path]()

    @hydra.main(config_path=str(config.CONFIG_DIR), config_name="config", version_base="1.3")
    def job(composed: DictConfig) -> None:
        from omniperception import training

        settings = HydraConfig.get()
        task = [text for text in settings.overrides.task if not text.startswith(f"++{config.SEARCH_PATH}=")]
        run_dir = Path(os.path.relpath(settings.runtime.output_dir))
        begun.append(run_dir)
        try:
            with terminal():  # or Hydra says more than what a disk refuses
                training.train(config.finish(composed, settings.runtime.choices.get("condition")), run_dir, task, trust)
        except UserError as error:
            with suppress(OSError):  # nothing was written into it
                run_dir.rmdir()
            in_turn = sweeps and settings.launcher["_target_"].endswith("BasicLauncher")
            if not in_turn or training.distributed.world_size() > 1:
                fail(error)  # this process has others that wait for it, or is the job's own
            print(f"error: {run_dir}: {one_line(error)}", file=sys.stderr, flush=True)
            failed.append(run_dir)

    before, sys.argv = sys.argv, [sys.argv[0], *flags, *texts, *found]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # or it prints a traceback of what this program says in one line
    try:
        job()
    except (HydraException, ValueError) as error:
        if begun and not isinstance(error, HydraException):
            raise
        raise config.ConfigError(one_line(error)) from None  # such as flags that exclude each other
    finally:
        sys.argv = before
    if failed:
        raise config.ConfigError(f"{len(failed)} of {len(begun)} jobs failed: {', '.join(map(str, failed))}")


command = Command(main, Arguments, __doc__, "of the configuration", flags=HYDRAS)
