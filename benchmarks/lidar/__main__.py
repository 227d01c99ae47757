"""How fast and how exact the LiDAR toolkit is, beside every other way of casting rays that is installed.

    python scripts/benchmark_lidar.py what=baselines repeats=7 motions=smooth,static

baselines  the same moving scene for every method in turn, with pose update: speed, error against float64, and targets
terrain    a terrain of 80,000 triangles against Embree
scaling    cost against rays, environments, bodies and triangles, and memory per environment (CSV and PNG)
paper      the paper's appendix case, and its rendering-time table; on a CPU the sizes that fit
features   time and memory with and without each output, noise, motion distortion and moving bodies

Baselines that are not installed are named and left out. To have them all:

    pip install embreex mujoco-lidar jax
    pip install --no-deps newton mujoco-warp etils taichi tibvh colorama
    pip install open3d                        (and the system's libusb-1.0)

Everything is also written to `out` as JSON, CSV and Markdown, with the commit, the machine and all versions. On a
machine that does other work, trust the ratios by CPU time. What was measured stands in docs/lab/lidar.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from benchmarks.harness.table import Table, about, machine_line, report
from omniperception.config import ConfigError
from omnirobot.common.cli import Command, argument

from .baselines import MUJOCO_LIDAR, NEWTON, ONE_MESH
from .compare import Options, compare_baselines, compare_terrain, measure_features
from .paper import measure_appendix, measure_table
from .scaling import measure_scaling, plot_scaling, sweeps
from .scenes import MOTIONS

FEW_FEATURES = ("output points_s", "mask noise")
GPU_RIVALS = (f"{MUJOCO_LIDAR} warp tree", NEWTON, "mujoco_warp rays", ONE_MESH)
"""Baselines beside ours in the paper's table on a GPU."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    what: str = argument("baselines", "study", choices=("baselines", "terrain", "scaling", "paper", "features"))
    repeats: int = argument(7, "rounds in which every method is timed", least=1)
    threads: int = argument(2, "CPU threads of each method", least=1)
    device: str = argument("cpu", "cpu or cuda:<index>")
    motions: tuple[str, ...] = argument(MOTIONS, "scenes of what=baselines", choices=MOTIONS)
    size: str = argument("full", "small: in seconds, to see that everything works", choices=("full", "small"))
    out: Path = argument(Path("outputs/benchmark_lidar"), "folder of the results")

    @property
    def small(self) -> bool:
        return self.size == "small"

    @property
    def options(self) -> Options:
        options = Options(rounds=self.repeats, num_threads=self.threads, device=self.device)
        return replace(options, num_envs=4, num_rays=200, num_frames=2, num_samples=400) if self.small else options


def _scaling(given: Arguments) -> list[Table]:
    chosen = sweeps(quick=given.small)
    table = measure_scaling(given.options, chosen)
    given.out.mkdir(parents=True, exist_ok=True)
    plot_scaling(table, chosen, given.out / "scaling.png", machine_line(about(given.threads, given.device)))
    return [table]


def _paper(given: Arguments) -> list[Table]:
    appendix = measure_appendix(given.options, scale=0.02 if given.small else 1.0)
    rivals = GPU_RIVALS if given.device.startswith("cuda") else ()
    return [appendix, measure_table(given.options, max_rays=300_000 if given.small else None, rivals=rivals)]


STUDIES: dict[str, Callable[[Arguments], list[Table]]] = {
    "baselines": lambda given: compare_baselines(given.options, given.motions),
    "terrain": lambda given: compare_terrain(given.options, cells=20 if given.small else 200),
    "scaling": _scaling,
    "paper": _paper,
    "features": lambda given: measure_features(given.options, FEW_FEATURES if given.small else None),
}


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    if given.device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device={given.device}: there is no CUDA device here; use device=cpu")
    report(STUDIES[given.what](given), about(given.threads, given.device), given.out)


command = Command(main, Arguments, __doc__)

if __name__ == "__main__":
    command()
