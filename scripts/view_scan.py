"""Draws what a LiDAR sees: its pattern after 0.1, 0.5 and 1 s, and a scan of a demonstration scene.

    python scripts/view_scan.py lidar=avia [out=outputs/view_scan/avia] [seed=0] [rays=all] [seconds=0.1]
                                [colour=class|height] [lidar.sensor.max_range=30 and other overrides of the preset]
    python scripts/view_scan.py lidar=mid360,avia,os0_128,vlp16      # each of them, and comparison.png

Any preset of conf/lidar will do. The scene is a room with people, thin rods, a shelf without legs, a rock, rubble and
the robot itself, which carries the sensor. Writes pattern.png, scan.png and scan.ply; the pictures need the extra
`plots`. `seconds` is one frame of the preset unless given, `rays` how many of its points are kept.
"""

from __future__ import annotations

import sys
from pathlib import Path

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
from benchmarks.figures import PlotsUnavailable
from benchmarks.view_scan import draw_comparison, summary, take_scan, write_scan
from omniperception import build, config
from omniperception.lidar.demo_scene import demo_scene

DEFAULTS = {"out": "", "seed": "0", "rays": "all", "seconds": "", "colour": "class"}
COLOURS = ("class", "height")
FILES = ("pattern.png", "scan.png", "scan.ply")
NO_TASK = ("perception=none", "observations=walk", "rewards=walk")
"""A sensor is looked at, no task is run."""


def main() -> None:
    with config.one_line_errors(PlotsUnavailable, ModuleNotFoundError, ValueError):
        own, overrides = config.split_arguments(sys.argv[1:], DEFAULTS)
        if own["colour"] not in COLOURS:
            raise config.ConfigError(f"colour={own['colour']} must be one of {', '.join(COLOURS)}")
        seconds = float(config.positive("seconds", own["seconds"], float)) if own["seconds"] else None
        rays = None if own["rays"] == "all" else int(config.positive("rays", own["rays"], int))
        seed = _whole("seed", own["seed"])
        given = [o.split("=", 1)[1] for o in overrides if o.startswith("lidar=")]
        names = (given or ["mid360"])[-1].split(",")
        if "none" in names:
            raise config.ConfigError("lidar=none has nothing to view; give a sensor, such as lidar=mid360")
        out = Path(own["out"] or "outputs/view_scan")
        scans = []
        for name in names:
            others = [o for o in overrides if not o.startswith("lidar=")]
            env = build.assemble(config.compose([*NO_TASK, f"lidar={name}", *others])).env
            demo = demo_scene(env.robot)
            scans.append(take_scan(name, env.lidar, demo, seconds, rays, seed))
            folder = out if own["out"] and len(names) == 1 else out / name
            write_scan(scans[-1], env.lidar, demo, folder, own["colour"])
            print(f"{summary(scans[-1])}\nwritten: {', '.join(str(folder / file) for file in FILES)}", flush=True)
        if len(names) > 1:
            draw_comparison(scans, demo, out / "comparison.png")
            print(f"written: {out / 'comparison.png'}")


def _whole(key: str, text: str) -> int:
    if not text.isdecimal():
        raise config.ConfigError(f"{key}={text} must be a whole number >= 0")
    return int(text)


if __name__ == "__main__":
    main()
