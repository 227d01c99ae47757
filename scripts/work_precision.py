"""Accuracy against cost of the choices that the framework offers, side by side in one run.

    python scripts/work_precision.py subject=lidar|physics|perception [only=shapes,rays] [size=full|small]
        [out=outputs/work_precision] [overrides, e.g. lidar=avia]
    python scripts/work_precision.py subject=policy [runs=<run directory>,...] [default=<one of them>]

lidar       shapes, updates, poses, rays, rates, motion, precision: shapes or triangles, updates of moving bodies, stale
            poses, rays kept, frames per second, motion within a frame, precision of the ranges
physics     steps, solver, order: time step and integrator, PD law in the engine or outside, iterations and friction
            cone, and the order of convergence of smooth motion
perception  farthest, heights, sectors, history: points kept and how, and how many frames of them a network sees
policy      what scripts/evaluate.py measured against the time of the policy that scripts/export.py wrote; by default of
            all runs under outputs/ that have both

Everything runs on one thread, choices in turn; a cost is this process's CPU time in the quickest round. Writes a table
(CSV, JSON) for each study and one plot with all fronts, the default marked, into <out>/<subject>/. The default is what
the composed configuration chooses. What was measured stands in docs/lab/work_precision.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
from benchmarks.figures import PlotsUnavailable
from benchmarks.work_precision.run import SIZES, SUBJECTS, Options, execute
from omniperception import config
from omniperception.deploy import DeployError
from omniperception.learning import CheckpointError

OWN = {"subject": "", "only": "", "size": "full", "out": "outputs/work_precision", "runs": "", "default": ""}


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(PlotsUnavailable, CheckpointError, DeployError):
        own, overrides = config.split_arguments(sys.argv[1:], OWN)
        if own["subject"] not in SUBJECTS:
            raise config.ConfigError(f"subject={own['subject']} must be one of {', '.join(SUBJECTS)}")
        if own["size"] not in SIZES:
            raise config.ConfigError(f"size={own['size']} must be one of {', '.join(SIZES)}")
        only, runs = (tuple(own[key].split(",")) if own[key] else () for key in ("only", "runs"))
        small = own["size"] == "small"
        execute(Options(own["subject"], Path(own["out"]), small, only, tuple(overrides), runs, own["default"]))


if __name__ == "__main__":
    main()
