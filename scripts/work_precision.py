"""Accuracy against cost of the choices that the framework offers, side by side in one run.

    python scripts/work_precision.py subject=lidar [only=shapes,rays] [size=full|small]
        [out=outputs/work_precision] [overrides, e.g. lidar=avia]

lidar       shapes or triangles, updates of moving bodies, stale poses, rays kept, frame rate, motion within a frame

Everything runs on one thread, choices in turn; a cost is the median of this process's CPU time. Writes a table (CSV,
JSON) for each study and one plot with all fronts, the default marked, into <out>/<subject>/. The default is what the
composed configuration chooses. What was measured stands in docs/work_precision.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
from omniperception import config
from omniperception.analysis.figures import PlotsUnavailable
from omniperception.analysis.work_precision.run import SIZES, SUBJECTS, Options, execute

OWN = {"subject": "", "only": "", "size": "full", "out": "outputs/work_precision"}


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(PlotsUnavailable):
        own, overrides = config.split_arguments(sys.argv[1:], OWN)
        if own["subject"] not in SUBJECTS:
            raise config.ConfigError(f"subject={own['subject']} must be one of {', '.join(SUBJECTS)}")
        if own["size"] not in SIZES:
            raise config.ConfigError(f"size={own['size']} must be one of {', '.join(SIZES)}")
        only = tuple(own["only"].split(",")) if own["only"] else ()
        execute(Options(own["subject"], Path(own["out"]), own["size"] == "small", only, tuple(overrides)))


if __name__ == "__main__":
    main()
