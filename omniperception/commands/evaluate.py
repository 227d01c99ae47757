"""Evaluates a run in fixed scenarios: rates with 95 % intervals, clearance, time, energy, beside baselines.

    evaluate run=latest scenario=all policy=run,blind
    evaluate run=pretrained/avoider scenario=corridor trials=250 commands.speed=0.8

A scenario from conf/scenario replaces the run's obstacles, commands, terminations, terrain, randomization and seed; the
run keeps its robot, LiDAR, observations, rewards and networks. Overrides go on top. The same seed, number of trials and
of environments give the same result. Policies:

    run        the run's
    blind      the same, its LiDAR covered
    scripted   follows V_cmd + V_avoid, computed by the run's avoidance controller from ground-truth distances: the
               walker's policy, or without one the run's own, which sees no frame
    command    the walker's, which follows V_cmd alone
    exported   the run's as the export command wrote it, on raw points, joint states and IMU

Writes evaluation/<scenario>.json (summary), .csv (every trial) and .png (trajectories) into the run directory.
"""

from __future__ import annotations

from dataclasses import dataclass

from omniperception import config
from omniperception.cli import Command, argument, trust
from omniperception.common.figures import PlotsUnavailable
from omniperception.evaluation.suite import POLICIES, Evaluation, evaluate
from omniperception.learning import CheckpointError


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    run: str = argument("latest", "run directory, or latest for the newest under outputs/")
    scenario: tuple[str, ...] = argument(("corridor",), "scenarios, or all")
    trials: int = argument(1000, "trials of each policy in each scenario, at least", least=1)
    policy: tuple[str, ...] = argument(("run",), "policies", choices=tuple(POLICIES))
    num_envs: int | None = argument(None, "environments at a time; null: even rounds of at most 256", least=1)
    walker: str | None = argument(None, "run directory of experiment=walk, for policies that only walk")
    plots: bool = argument(True, "whether trajectories are drawn")
    trust: tuple[str, ...] = trust()


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Evaluates, prints tables and writes the run's evaluation folder."""
    run_dir = config.find_run(arguments.run)
    known = config.presets("scenario", config.search_path(overrides, config.read(run_dir)))
    evaluate(
        Evaluation(
            run_dir=run_dir,
            scenarios=known if arguments.scenario == ("all",) else arguments.scenario,
            policies=arguments.policy,
            trials=arguments.trials,
            num_envs=arguments.num_envs,
            walker=config.find_run(arguments.walker, "walker") if arguments.walker else None,
            plots=arguments.plots,
            overrides=tuple(overrides),
            trust=arguments.trust,
        )
    )


command = Command(main, Arguments, __doc__, "of the run's configuration", (CheckpointError, PlotsUnavailable))
