"""Draws what a LiDAR sees: its pattern after 0.1, 0.5 and 1 s, and a scan of a demonstration scene.

    python scripts/view_scan.py lidar=avia [out=outputs/view_scan/avia] [seed=0] [rays=all] [seconds=0.1]
                                [colour=class|height] [lidar.sensor.max_range=30 and other overrides of the preset]

Any preset of conf/lidar will do. The scene is a room with people, thin rods, a shelf without legs, a rock, rubble and
the robot itself, which carries the sensor. Writes pattern.png, scan.png and scan.ply; the pictures need the extra
`plots`. `seconds` is one frame of the preset unless given, `rays` how many of its points are kept.
"""

from __future__ import annotations

import sys
from pathlib import Path

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
from omniperception import config
from omniperception.analysis.figures import PlotsUnavailable
from omniperception.analysis.view_scan import summary, view_scan

DEFAULTS = {"out": "", "seed": "0", "rays": "all", "seconds": "", "colour": "class"}
COLOURS = ("class", "height")
NO_TASK = ("perception=none", "observations=walk", "rewards=walk")
"""A sensor is looked at, no task is run."""


def main() -> None:
    with config.one_line_errors(PlotsUnavailable, ModuleNotFoundError, ValueError):
        own, overrides = config.split_arguments(sys.argv[1:], DEFAULTS)
        name = next((o.split("=", 1)[1] for o in overrides if o.startswith("lidar=")), "mid360")
        if name == "none":
            raise config.ConfigError("lidar=none has nothing to view; give a sensor, such as lidar=mid360")
        if own["colour"] not in COLOURS:
            raise config.ConfigError(f"colour={own['colour']} must be one of {', '.join(COLOURS)}")
        env = config.assemble(config.compose([*NO_TASK, *overrides])).env
        out = Path(own["out"] or f"outputs/view_scan/{name}")
        scan = view_scan(
            name,
            env.lidar,
            env.robot,
            out,
            seconds=float(config.positive("seconds", own["seconds"], float)) if own["seconds"] else None,
            num_rays=None if own["rays"] == "all" else int(config.positive("rays", own["rays"], int)),
            seed=_whole("seed", own["seed"]),
            colour=own["colour"],
        )
        print(summary(scan))
        print(f"written: {', '.join(str(out / file) for file in ('pattern.png', 'scan.png', 'scan.ply'))}")


def _whole(key: str, text: str) -> int:
    if not text.isdecimal():
        raise config.ConfigError(f"{key}={text} must be a whole number >= 0")
    return int(text)


if __name__ == "__main__":
    main()
