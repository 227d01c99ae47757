"""Writes conf/robot/<name>.yaml for a robot from its file, MJCF or URDF, and says what it guessed.

    robot-new robots/spider.urdf
    robot-new g1.xml name=g1 joints=left_hip_pitch_joint,left_knee_joint frequency=3 lidar=head_link

The file says the joints, their limits and, where it has actuators, which of them are driven and how strong they are.
Feet, default pose, gains, action scale, links that can touch each other, mirror images and places for a LiDAR are
found from geometry and masses. The robot is stood on a plane for 2 s with the result. The last line says what comes
next: robot-check.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.config import ConfigError
from omniperception.robots.guess import Options, guess
from omniperception.robots.preset import table_of, text_of
from omnirobot.common.cli import Command, argument
from omnirobot.common.files import write_whole
from omnirobot.common.shell import command_line


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """The command's own arguments."""

    file: Path = argument(doc="MJCF or URDF of the robot; the preset names it like this")
    name: str | None = argument(None, "of the preset; null: the file's")
    out: Path = argument(Path("conf/robot"), "folder of the preset, called robot")
    again: bool = argument(False, "whether a preset of that name is written over")


def main(arguments: Arguments) -> None:
    """Guesses, writes and tells."""
    if not arguments.file.is_file():
        raise ConfigError(f"file={arguments.file} is no file; give the robot's MJCF or URDF")
    name = arguments.name or re.sub(r"\W+", "_", arguments.file.stem).lower()
    if not re.fullmatch(r"\w+", name):
        raise ConfigError(f"name={name} must be letters, digits and underscores")
    folder = arguments.out.resolve()
    shipped = folder.parent == config.CONFIG_DIR.resolve()
    if folder.name != "robot":
        raise ConfigError(f"out={arguments.out} must be a folder called robot; give out={arguments.out / 'robot'}")
    if not shipped and name in config.presets("robot"):
        raise ConfigError(f"name={name} is a robot that comes with the package; give another name=...")
    path = arguments.out / f"{name}.yaml"
    if path.exists() and not arguments.again:
        raise ConfigError(f"{path} exists; give another name=..., or again=true to write over it")
    found = guess(arguments.file, str(arguments.file), arguments)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, text_of(found, arguments.file))
    print(table_of(found))
    stands = "stands" if found.standing.steady else "DOES NOT STAND"
    print(f"after 2 s it {stands}: base at {found.standing.height:.3f} m, inclined by {found.standing.tilt:.3f} rad")
    found_with = () if shipped else ("--config-dir", os.path.relpath(folder.parent))
    print(f"written: {path}; next: {command_line('robot-check', name, *found_with)}")


command = Command(main, Arguments, __doc__, errors=(ValueError,), first="file")
