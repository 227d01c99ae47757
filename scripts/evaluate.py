"""Evaluates a run in scenarios: rates with 95 % intervals, clearance, time, energy, beside baselines.

python scripts/evaluate.py run=latest scenario=corridor[,static,...|all] [trials=1000] [policy=run,blind,scripted]
    [walker=<run directory of experiment=walk>] [num_envs=250] [plots=true] [seed=7] [overrides]

A scenario from conf/scenario replaces the run's obstacles, commands, terminations, terrain, randomization and seed; the
run keeps its robot, LiDAR, observations, rewards and networks. Overrides go on top, e.g. commands.speed=0.8
terminations=collision. The same seed, number of trials and of environments give the same result. Policies:
    run        the run's
    blind      the same, its LiDAR covered
    scripted   told V_cmd + V_avoid, by the run's law from true distances: the walker's policy, or without one the
               run's own, which sees no frame
    command    the walker's, told V_cmd alone
    exported   the run's as scripts/export.py wrote it, on raw points, joint states and IMU
Writes evaluation/<scenario>.json (summary), .csv (every trial) and .png (trajectories) into the run directory.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from omniperception import config
from omniperception.evaluation.plots import PlotsUnavailable
from omniperception.evaluation.suite import Evaluation, evaluate
from omniperception.learning import CheckpointError

ARGUMENTS = {
    "run": "latest",
    "scenario": "corridor",
    "trials": "1000",
    "policy": "run",
    "num_envs": "",
    "walker": "",
    "plots": "true",
}


def parse(arguments: Sequence[str]) -> Evaluation:
    """From the command line."""
    own, overrides = config.split_arguments(arguments, ARGUMENTS)
    if own["plots"] not in ("true", "false"):
        raise config.ConfigError(f"plots={own['plots']} must be true or false")
    return Evaluation(
        run_dir=config.find_run(own["run"]),
        scenarios=config.scenarios() if own["scenario"] == "all" else own["scenario"].split(","),
        policies=own["policy"].split(","),
        trials=config.positive("trials", own["trials"], int),
        num_envs=config.positive("num_envs", own["num_envs"], int) if own["num_envs"] else None,
        walker=config.find_run(own["walker"]) if own["walker"] else None,
        plots=own["plots"] == "true",
        overrides=tuple(overrides),
    )


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(CheckpointError, PlotsUnavailable):
        evaluate(parse(sys.argv[1:]))


if __name__ == "__main__":
    main()
