"""Everything that a GPU has to show, in under nine minutes: correctness, then measurements, then a short training.

    python scripts/gpu_check.py [device=cuda:0|cpu] [size=full|small] [only=tests,lidar,steps,waits,rays,env,training]
        [minutes=8] [out=outputs/gpu_check]

tests      the tests marked gpu
lidar      ranges against mj_ray
steps      one physics step against mj_step; graph replay against the CPU
waits      where a control step waits for the GPU
rays       the paper's rendering-time table, also beside the paper's scheme and mujoco_warp.rays
env        environment steps per second at 4096 environments, by stage
training   whole PPO iterations of experiment=paper, and memory beside its prediction

Every part writes its tables to `out` as CSV, JSON and markdown as soon as it has them; `summary.md` tells what ran.
No part begins after `minutes`. Without a GPU, `device=cpu size=small` runs everything at tiny sizes. Exit codes: 0 all
good, 1 something failed or was wrong, 2 wrong arguments or no GPU.
"""

from __future__ import annotations

import sys
from pathlib import Path

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
import torch

from benchmarks.gpu_check import PARTS, CheckOptions, execute
from omniperception import config

DEFAULTS = {"device": "cuda:0", "size": "full", "only": "", "minutes": "8", "out": "outputs/gpu_check"}


def main() -> int:
    with config.one_line_errors():
        own, unknown = config.split_arguments(sys.argv[1:], DEFAULTS)
        if unknown:
            raise config.ConfigError(f"{' '.join(unknown)}: known arguments are {', '.join(DEFAULTS)}")
        options = parse(own)
    return 0 if execute(options) else 1


def parse(own: dict[str, str]) -> CheckOptions:
    only = tuple(name for name in own["only"].split(",") if name)
    if wrong := sorted(set(only) - set(PARTS)):
        raise config.ConfigError(f"only={','.join(wrong)} must be out of {', '.join(PARTS)}")
    if own["size"] not in ("full", "small"):
        raise config.ConfigError(f"size={own['size']} must be full or small")
    if own["device"] != "cpu" and not (own["device"].startswith("cuda:") and torch.cuda.is_available()):
        raise config.ConfigError(
            f"device={own['device']}: there is no such GPU here; device=cpu size=small runs everything tiny"
        )
    minutes = config.positive("minutes", own["minutes"], float)
    return CheckOptions(own["device"], own["size"] == "small", Path(own["out"]), only, minutes)


if __name__ == "__main__":
    sys.exit(main())
