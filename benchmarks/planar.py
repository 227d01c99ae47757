"""Decisions a second of worlds without legs, beside the same in full physics.

    python -m benchmarks.planar                  # true sectors; 2,000 rays and perception; each with and without legs
    python -m benchmarks.planar threads=1 rounds=5

A decision is 0.1 s: a policy says what velocity is asked for, and robots, obstacles and what is seen of them follow.
With legs that takes five control steps of a gait. The policies are untrained, which costs as much; nothing is learned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.harness.table import Table, about, report
from benchmarks.harness.timing import Timing, paired_ratio, paired_timings
from omniperception import build, config
from omniperception.avoidance.velocity_risk import VelocityRisk
from omnirobot.common.cli import Command, argument

DECISION_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    rounds: int = argument(5, "rounds in which all are timed in turn", least=1)
    threads: int = argument(2, "CPU threads", least=1)
    told_envs: int = argument(2048, "robots without legs that are told the true sectors", least=1)
    seeing_envs: int = argument(512, "robots without legs that see", least=1)
    walking_envs: int = argument(256, "robots with legs", least=1)
    out: Path = argument(Path("outputs/benchmark_planar"), "folder of the results")


def decisions(overrides: list[str], risk: VelocityRisk | None = None) -> tuple[int, Callable[[int], None]]:
    """Robots of a task, and one decision of all; with a `risk` the true sectors are measured and weighed by it."""
    run = build.assemble(config.compose(overrides))
    runner = build.build_runner(run, None)
    env, policy = runner.env, runner.policy
    if env.obstacles is not None:
        env.obstacles.level = 1.0
    steps = round(DECISION_S / env.control_dt)

    def decide(_: int) -> None:
        with torch.inference_mode():
            if risk is not None:
                risk.risk(env.state.sectors, risk.candidates())
            for _ in range(steps):
                env.step(policy(env.get_observations()))

    return env.num_envs, decide


def measure(given: Arguments) -> Table:
    """All of them, in turn."""
    torch.set_num_threads(given.threads)
    world = ["obstacles=crowd", "obstacles.curriculum=null", f"sim.num_threads={given.threads}"]
    seeing = [*world, "lidar.num_rays=2000"]
    navigate, perceive = "experiment=navigate", "experiment=perceive"
    subjects = {
        "true sectors": decisions([navigate, *world, f"num_envs={given.told_envs}"]),
        "true sectors, legs": decisions(
            ["experiment=gait", "terrain=flat", *world, f"num_envs={given.walking_envs}"],
            build.assemble(config.compose([navigate])).env.rewards.avoidance.risk,
        ),
        "2,000 rays and perception": decisions(
            [perceive, "sim.decimation=4", *seeing, f"num_envs={given.seeing_envs}"]
        ),
        "2,000 rays and perception, legs": decisions(
            ["experiment=navigator", "terrain=flat", *seeing, f"num_envs={given.walking_envs}"]
        ),
    }
    timings = paired_timings({name: decide for name, (_, decide) in subjects.items()}, given.rounds, calls_per_block=3)
    per_decision = {
        name: Timing([s / subjects[name][0] for s in timing.wall_s], [s / subjects[name][0] for s in timing.cpu_s])
        for name, timing in timings.items()
    }
    table = Table(
        "planar", "decisions of 0.1 s, without legs and with them", ("timed", "robots", "decisions/s", "times legs")
    )
    for name, timing in per_decision.items():
        legs = per_decision.get(f"{name}, legs")
        ratio = "" if legs is None else str(paired_ratio(legs, timing, "wall"))
        table.rows.append((name, subjects[name][0], 1.0 / timing.median_s, ratio))
    return table


def main(given: Arguments) -> None:
    """Times, prints and writes."""
    report([measure(given)], about(given.threads), given.out)


command = Command(main, Arguments, __doc__)

if __name__ == "__main__":
    command()
