"""What `scripts/work_precision.py` can be asked for: measure, print, write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.figures import new_figure
from benchmarks.lidar_benchmark.report import machine, machine_line, write
from omniperception import build, config
from omniperception.perception import PdSampler

from . import lidar, perception, physics, policy
from .pareto import Study, plot

SIZES = ("full", "small")


@dataclass(frozen=True)
class Options:
    """The command line.

    Attributes:
        subject: A name out of ``SUBJECTS``.
        out: Folder of the results of all subjects.
        small: Whether sizes are tiny, to see in seconds that everything works.
        only: Names of the studies to run; all if empty.
        overrides: Of the configuration.
        runs: Run directories whose policies are compared; all that are evaluated and exported if empty.
        default: The one of them that counts as the default, or none.
    """

    subject: str
    out: Path
    small: bool = False
    only: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()
    runs: tuple[str, ...] = ()
    default: str = ""


def run_lidar(options: Options) -> Iterator[Study]:
    run = build.assemble(config.compose(_with("obstacles=mixed", options.overrides)))
    if run.env.lidar is None:
        raise config.ConfigError("lidar=none leaves nothing to measure; use lidar=mid360")
    return lidar.measure(run, lidar.SMALL if options.small else lidar.Sizes(), options.only)


def run_physics(options: Options) -> Iterator[Study]:
    run = build.assemble(config.compose(_with("experiment=walk", options.overrides)))
    try:
        yield from physics.measure(run, physics.SMALL if options.small else physics.Sizes(), options.only)
    except ValueError as error:
        raise config.ConfigError(str(error)) from None


def run_perception(options: Options) -> Iterator[Study]:
    overrides = _with("experiment=quickstart", options.overrides)
    run = build.assemble(config.compose(overrides))
    if run.perception is None or not isinstance(run.perception.sampler(), PdSampler):
        raise config.ConfigError("the perception must sample a proximal and a distal half; use perception=pd_risknet")
    return perception.measure(overrides, perception.SMALL if options.small else perception.Sizes(), options.only)


def run_policy(options: Options) -> Iterator[Study]:
    if options.overrides:
        raise config.ConfigError(
            f"{options.overrides[0]}: policies are taken as they were trained; leave overrides out"
        )
    if options.only:
        raise config.ConfigError("only= chooses no scenario; evaluate the runs in those that should be compared")
    return policy.measure(options.runs, policy.SMALL if options.small else policy.Sizes(), options.default)


STUDIES = {
    "lidar": tuple(lidar.STUDIES),
    "physics": physics.STUDIES,
    "perception": tuple(perception.STUDIES),
    "policy": (),
}
SUBJECTS: dict[str, Callable[[Options], Iterator[Study]]] = {
    "lidar": run_lidar,
    "physics": run_physics,
    "perception": run_perception,
    "policy": run_policy,
}


def execute(options: Options) -> list[Study]:
    """Measures a subject, prints its tables with what they say, and writes them with the plot."""
    if options.subject != "policy" and (unknown := set(options.only) - set(STUDIES[options.subject])):
        known = ", ".join(STUDIES[options.subject])
        raise config.ConfigError(f"only={','.join(sorted(unknown))} must be out of {known}")
    new_figure(1.0, 1.0)  # an error now rather than after minutes
    torch.set_num_threads(1)
    folder, about = options.out / options.subject, machine(1, "cpu")
    studies = []
    for study in SUBJECTS[options.subject](options):
        studies.append(study)
        table = study.table()
        write(table, about, folder)
        print(f"{table.markdown()}\n", flush=True)
    plot(studies, folder / "fronts.png", machine_line(about))
    print(f"{machine_line(about)}\nwrote {folder}")
    return studies


def _with(preset: str, overrides: tuple[str, ...]) -> list[str]:
    """Overrides with a preset in front, unless they choose that group themselves."""
    group = preset.split("=")[0] + "="
    return [*overrides] if any(o.startswith(group) for o in overrides) else [preset, *overrides]
