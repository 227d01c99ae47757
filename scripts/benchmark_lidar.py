"""How fast and how exact the LiDAR toolkit is, beside every other way of casting rays that is installed.

    python scripts/benchmark_lidar.py [what=peers|terrain|scaling|paper|features|table] [repeats=7] [threads=2]
        [device=cpu|cuda:0] [out=outputs/benchmark_lidar] [motions=smooth,jump,static] [size=full|small]

peers     the same moving scene for every method in turn, with pose update: speed, error against float64, and the bars
terrain   a terrain of 80,000 triangles against Embree
scaling   cost against rays, environments, bodies and triangles, and memory per environment (CSV and PNG)
paper     the paper's appendix case, and its rendering-time table; on a CPU the sizes that fit
features  time and memory with and without each output, noise, motion distortion and moving bodies
table     markdown of what lies in `out`

Peers that are not installed are named and left out. To have them all:

    pip install embreex mujoco-lidar jax
    pip install --no-deps newton mujoco-warp etils taichi tibvh colorama
    pip install open3d                        (and the system's libusb-1.0)

Everything is also written to `out` as JSON, CSV and markdown, with the date, the machine and all versions. On a machine
that does other work, trust the ratios by CPU time. What was measured stands in docs/lab/lidar.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
from benchmarks.figures import PlotsUnavailable
from benchmarks.lidar_benchmark.run import RUNS, ArgumentError, RunOptions, execute
from omniperception import config

DEFAULTS = {
    "what": "peers",
    "repeats": "7",
    "threads": "2",
    "device": "cpu",
    "out": "outputs/benchmark_lidar",
    "motions": "smooth,jump,static",
    "size": "full",
}


def main() -> None:
    with config.one_line_errors(ArgumentError, PlotsUnavailable):
        own, unknown = config.split_arguments(sys.argv[1:], DEFAULTS)
        if unknown:
            raise config.ConfigError(f"{' '.join(unknown)}: known arguments are {', '.join(DEFAULTS)}")
        if own["what"] not in (*RUNS, "table"):
            raise config.ConfigError(f"what={own['what']} must be one of {', '.join(RUNS)}, table")
        execute(own["what"], parse(own))


def parse(own: dict[str, str]) -> RunOptions:
    """The arguments as numbers and paths, or a one-line error."""
    try:
        return RunOptions(
            rounds=int(own["repeats"]),
            num_threads=int(own["threads"]),
            device=own["device"],
            out=Path(own["out"]),
            motions=tuple(own["motions"].split(",")),
            size=own["size"],
        )
    except ValueError as error:
        raise ArgumentError(str(error)) from None


if __name__ == "__main__":
    main()
