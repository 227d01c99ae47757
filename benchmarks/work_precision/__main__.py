"""Accuracy against cost of the choices that the framework offers, side by side in one run.

    python scripts/work_precision.py subject=lidar only=shapes,rays lidar=avia
    python scripts/work_precision.py subject=policy runs=<run directory>,<run directory>

lidar    shapes, poses, rays, rates, motion: shapes or triangles, stale poses, rays kept, frames per second, motion
         within a frame
physics  steps, solver: time step and integrator, PD law in the engine or outside, iterations and friction cone
policy   what scripts/evaluate.py measured against the time of the policy that scripts/export.py wrote; by default of
         all runs under outputs/ that have both

Everything runs on one thread, choices in turn; a cost is this process's CPU time in the quickest round. Writes a table
(CSV, JSON, Markdown) for each study and one plot with all fronts, the default marked, into <out>/<subject>/. The
default is what the composed configuration chooses. What was measured stands in docs/lab/work_precision.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.harness.pareto import Study, plot
from benchmarks.harness.table import about, machine_line, report
from omniperception import build, config
from omniperception.config import ConfigError
from omnirobot.common.cli import Command, argument, refuse_arguments
from omnirobot.common.figures import new_figure

from . import lidar, physics, policy


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    subject: str = argument(doc="what is compared", choices=("lidar", "physics", "policy"))
    only: tuple[str, ...] = argument((), "studies to run; all if not given")
    size: str = argument("full", "small: in seconds, to see that everything works", choices=("full", "small"))
    out: Path = argument(Path("outputs/work_precision"), "folder of the results of all subjects")
    runs: tuple[str, ...] = argument((), "run directories whose policies are compared; all evaluated and exported ones")
    default: str = argument("", "the one of runs= that counts as the default")

    @property
    def small(self) -> bool:
        return self.size == "small"


def _lidar(given: Arguments, overrides: list[str]) -> Iterator[Study]:
    run = build.assemble(config.compose(_with("obstacles=mixed", overrides)))
    if run.env.lidar is None:
        raise ConfigError("lidar=none leaves nothing to measure; use lidar=mid360")
    return lidar.measure(run, lidar.SMALL if given.small else lidar.Sizes(), given.only)


def _physics(given: Arguments, overrides: list[str]) -> Iterator[Study]:
    run = build.assemble(config.compose(_with("experiment=walk", overrides)))
    return physics.measure(run, physics.SMALL if given.small else physics.Sizes(), given.only)


def _policy(given: Arguments, overrides: list[str]) -> Iterator[Study]:
    if overrides:
        raise ConfigError(f"{overrides[0]}: policies are taken as they were trained; leave overrides out")
    return policy.measure(given.runs, policy.SMALL if given.small else policy.Sizes(), given.default)


SUBJECTS: dict[str, tuple[Callable[[Arguments, list[str]], Iterator[Study]], tuple[str, ...]]] = {
    "lidar": (_lidar, tuple(lidar.STUDIES)),
    "physics": (_physics, tuple(physics.STUDIES)),
    "policy": (_policy, ()),
}
"""How a subject is measured, and its studies by name."""


def main(given: Arguments, overrides: list[str]) -> None:
    """Measures a subject, prints its tables with what they say, and writes them with the plot."""
    measure, known = SUBJECTS[given.subject]
    if given.subject != "policy":
        refuse_arguments(given, ("runs", "default"), "it is of subject=policy")
    if unknown := sorted(set(given.only) - set(known)):
        raise ConfigError(f"only={','.join(unknown)} must be out of {', '.join(known) or 'nothing: leave it out'}")
    new_figure(1.0, 1.0)  # an error now rather than after minutes
    torch.set_num_threads(1)
    folder, where, studies = given.out / given.subject, about(1), []

    def tables():
        for study in measure(given, overrides):
            studies.append(study)
            yield study.table()

    report(tables(), where, folder)
    plot(studies, folder / "fronts.png", machine_line(where))


def _with(preset: str, overrides: list[str]) -> list[str]:
    """Overrides with a preset in front, unless they choose that group themselves."""
    group = preset.split("=")[0] + "="
    return overrides if any(o.startswith(group) for o in overrides) else [preset, *overrides]


command = Command(main, Arguments, __doc__, "of the configuration")

if __name__ == "__main__":
    command()
