"""Error of a run's perceived heights on terrain and obstacles that its training has not seen.

    python scripts/height_error.py run=latest steps=500

Unless overridden: terrain=mixed with another seed, robots on tiles of all difficulties, all kinds of obstacles in other
sizes. Root mean squared errors in cm with 95 % intervals; heights.json goes into the run's evaluation folder.
"""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.harness.table import Table, about, report
from omniperception import build, config
from omniperception.cli import Command, argument
from omniperception.config import ConfigError
from omniperception.env.config import HEIGHT_TARGET
from omniperception.evaluation.heights import HeightErrors, height_errors
from omniperception.evaluation.suite import FOLDER
from omniperception.learning import CheckpointError, latest_checkpoint

HELD_OUT = (
    "terrain=mixed",
    "terrain.seed=1000",
    "terrain.curriculum=null",
    "obstacles=all",
)
MEASURED = "perception.height_weight=1"
"""Whatever the last stage of the training was supervised with."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    run: str = argument("latest", "run directory")
    num_envs: int = argument(128, "robots", least=1)
    steps: int = argument(500, "control steps", least=1)


def table(errors: HeightErrors) -> Table:
    """Errors in cm, a row per predictor."""
    columns = ("predictor", "RMSE, cm", "+-", "nearer than 0.3 m", "0.3 to 0.6 m", "beyond")
    rows = [
        (name, 100 * rmse, 100 * errors.half_width[name], *(100 * ring for ring in errors.by_distance[name]))
        for name, rmse in errors.rmse.items()
    ]
    return Table("heights", f"perceived heights, {errors.frames} frames", columns, rows)


def main(given: Arguments, overrides: list[str]) -> None:
    """Measures, prints and writes."""
    run_dir = config.find_run(given.run)
    if not config.load(run_dir).perception:
        raise ConfigError(f"run={given.run} sees nothing; give a run with perception")
    overrides = [*HELD_OUT, MEASURED, "seed=1000", *overrides, f"num_envs={given.num_envs}"]
    run = build.assemble(config.load(run_dir, overrides))
    if HEIGHT_TARGET not in run.perception.build_network().supervised:
        raise ConfigError(f"run={given.run} says nothing about heights; give a run of perception=pd_risknet")
    runner = build.build_runner(run, None)
    checkpoint = latest_checkpoint(run_dir)
    runner.load_policy(checkpoint)
    errors = height_errors(runner.env, runner.policy, runner.alg.actor, given.steps)
    report([table(errors)], about(1, checkpoint=checkpoint.name, overrides=overrides), run_dir / FOLDER)


command = Command(main, Arguments, __doc__, "of the run's configuration", (CheckpointError,))

if __name__ == "__main__":
    command()
