"""What `scripts/benchmark_lidar.py` can be asked for: measure, print, write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from .compare import Options, compare_peers, compare_terrain
from .features import measure_features
from .paper import measure_appendix, measure_table
from .peers import MUJOCO_LIDAR, NEWTON, ONE_MESH
from .report import Table, machine, machine_line, write
from .scaling import measure_scaling, plot_scaling, sweeps
from .scenes import MOTIONS

SIZES = ("full", "small")
FEW_FEATURES = ("output points_s", "mask noise")
GPU_RIVALS = (f"{MUJOCO_LIDAR} warp tree", NEWTON, "mujoco_warp rays", ONE_MESH)
"""Peers beside ours in the paper's table on a GPU."""


class ArgumentError(ValueError):
    """A wrong command line; the message says what to change."""


@dataclass(frozen=True)
class RunOptions:
    """The command line.

    Attributes:
        rounds: How often each method is timed.
        num_threads: CPU threads of each method.
        device: "cpu" or "cuda:<index>".
        out: Folder of the results.
        motions: Which scenes ``peers`` compares.
        size: "full", or "small" to see in seconds that everything works.
    """

    rounds: int = 7
    num_threads: int = 2
    device: str = "cpu"
    out: Path = Path("outputs/benchmark_lidar")
    motions: tuple[str, ...] = MOTIONS
    size: str = "full"

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.num_threads < 1:
            raise ArgumentError(f"repeats={self.rounds} and threads={self.num_threads} must be at least 1")
        if self.size not in SIZES:
            raise ArgumentError(f"size={self.size} must be one of {', '.join(SIZES)}")
        if unknown := [motion for motion in self.motions if motion not in MOTIONS]:
            raise ArgumentError(f"motions={','.join(unknown)} must be out of {', '.join(MOTIONS)}")
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise ArgumentError(f"device={self.device}: there is no CUDA device here; use device=cpu")

    @property
    def small(self) -> bool:
        return self.size == "small"

    @property
    def options(self) -> Options:
        options = Options(rounds=self.rounds, num_threads=self.num_threads, device=self.device)
        return replace(options, num_envs=4, num_rays=200, num_frames=2, num_samples=400) if self.small else options


def run_peers(run: RunOptions) -> list[Table]:
    return compare_peers(run.options, run.motions)


def run_terrain(run: RunOptions) -> list[Table]:
    return compare_terrain(run.options, cells=20 if run.small else 200)


def run_scaling(run: RunOptions) -> list[Table]:
    about, chosen = machine(run.num_threads, run.device), sweeps(quick=run.small)
    table = measure_scaling(run.options, chosen)
    run.out.mkdir(parents=True, exist_ok=True)
    plot_scaling(table, chosen, run.out / "scaling.png", machine_line(about))
    return [table]


def run_paper(run: RunOptions) -> list[Table]:
    appendix = measure_appendix(run.options, scale=0.02 if run.small else 1.0)
    device = "cuda:0" if torch.cuda.is_available() and not run.device.startswith("cuda") else run.device
    rivals = GPU_RIVALS if device.startswith("cuda") else ()
    table = measure_table(replace(run.options, device=device), max_rays=300_000 if run.small else None, rivals=rivals)
    return [appendix, table]


def run_features(run: RunOptions) -> list[Table]:
    return measure_features(run.options, FEW_FEATURES if run.small else None)


RUNS: dict[str, Callable[[RunOptions], list[Table]]] = {
    "peers": run_peers,
    "terrain": run_terrain,
    "scaling": run_scaling,
    "paper": run_paper,
    "features": run_features,
}


def execute(what: str, run: RunOptions) -> None:
    """Measures, prints and writes; ``table`` prints what earlier runs have written."""
    if what == "table":
        print(written(run.out))
        return
    about = machine(run.num_threads, run.device)
    for table in RUNS[what](run):
        write(table, about, run.out)
        print(f"{table.markdown()}\n")
    print(machine_line(about))


def written(folder: Path) -> str:
    """The markdown of all results in a folder."""
    files = sorted(folder.glob("*.md"))
    if not files:
        raise ArgumentError(f"out={folder} holds no results yet; run what=peers first")
    return "\n\n".join(file.read_text().strip() for file in files)
