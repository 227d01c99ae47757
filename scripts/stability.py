"""Where things hold and where they break, and that nothing breaks silently.

    python scripts/stability.py subject=physics|lidar|learning [out=outputs/stability/<subject>] [only=<part of a name>]
        physics:  [size=12] [num_envs=32] [seconds=4] [overrides of the robot and of sim, e.g. sim.timestep=0.002]
        lidar:    [rays=2000] [many=1000000]
        learning: [iterations=3]

physics   gains kp 5..2000, kv 0..50 by step 0.5..10 ms and integrator, PD in the engine and outside, with the analytic
          limit of the linearised joints; corners of the randomization, drops, impacts, overlaps, wild targets, latency.
          only=floating, only=standing or only=scenes runs one part.
lidar     rays far away, at tiny and huge bodies, bad triangles, grazing, inside, without poses, none and very many,
          each against float64.
learning  extreme rewards, observations, clouds, noise, gradients and batches, what training makes of them; float32
          against float64 by layer.

Writes CSV, JSON and figures (extra `plots`). Exit status 1 if something is not as it should be. docs/lab/stability.md
holds what was measured.
"""

from __future__ import annotations

import sys
from pathlib import Path

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
from benchmarks.figures import PlotsUnavailable
from benchmarks.stability.run import SUBJECTS, Options, execute
from omniperception import config

NUMBERS = {"size": "12", "num_envs": "32", "rays": "2000", "many": "1000000", "iterations": "3"}
ARGUMENTS = {"subject": "", "out": "", "only": "", "seconds": "4", **NUMBERS}


def parse(arguments: list[str]) -> tuple[str, Options]:
    """The subject and how it is run."""
    own, overrides = config.split_arguments(arguments, ARGUMENTS)
    subject = own["subject"]
    if subject not in SUBJECTS:
        raise config.ConfigError(f"subject={subject} must be one of {', '.join(SUBJECTS)}")
    if overrides and subject != "physics":
        raise config.ConfigError(f"{overrides[0]} is unknown for subject={subject}; known: {', '.join(ARGUMENTS)}")
    numbers = {key: int(config.positive(key, own[key], int)) for key in NUMBERS}
    seconds = config.positive("seconds", own["seconds"], float)
    out = Path(own["out"] or f"outputs/stability/{subject}").resolve()
    return subject, Options(out=out, only=own["only"], overrides=tuple(overrides), seconds=seconds, **numbers)


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(PlotsUnavailable, ValueError):
        subject, options = parse(sys.argv[1:])
        good = execute(subject, options)
        print(f"\nwritten to {options.out}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
