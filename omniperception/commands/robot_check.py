"""Stands a robot on a plane for 2 s, and lists contacts, joints and their reach, and what its LiDAR sees of it.

    robot-check go2
    robot-check spider lidar=vlp16 lidar.mount=front
    robot-check spider robot.kp=40 seconds=5

Writes picture.png: the robot as it stands, with the LiDAR's points, those on the robot red. Ends with exit code 1 if
the robot does not stand.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

from omniperception import build, config
from omniperception.robots.look import Sight, draw, look
from omniperception.robots.stand import NEAR, Stance, flat_world, reached_limits, stand
from omniperception.scene import World
from omnirobot.common.cli import Command, argument, refuse_overrides

NO_TASK = ("~experiment", "perception=none", "observations=walk", "rewards=walk")
"""A robot is looked at, no task is run."""
MANY_OWN = 0.3
"""A mount from which more than this share of the rays hits the robot deserves a look."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    name: str = argument(doc="preset of conf/robot")
    lidar: str = argument("mid360", "preset of conf/lidar; none: it is left out")
    seconds: float = argument(2.0, "how long the robot stands", positive=True)
    out: Path | None = argument(None, "folder of the picture; null: outputs/robot_check/<name>")


def main(arguments: Arguments, overrides: list[str]) -> None:
    """Prints the findings and draws the robot."""
    refuse_overrides(overrides, {"robot": arguments.name})
    composed = config.compose([*NO_TASK, f"robot={arguments.name}", f"lidar={arguments.lidar}", *overrides])
    env = build.assemble(composed).env
    world = flat_world(env.robot)
    standing, data = stand(world, arguments.seconds)
    print(_on_standing(world, standing, arguments.seconds))
    print(_on_contacts(world, standing))
    print(_on_joints(world, standing))
    sight = None
    if env.lidar is not None:
        sight = look(world, data, env.lidar)
        print(_on_sight(sight, env.lidar.mount_body or env.robot.base))
    path = (arguments.out or Path("outputs/robot_check") / arguments.name) / "picture.png"
    draw(world, data, sight, path)
    print(f"written: {path}")
    if not standing.steady:
        sys.exit(1)


def _on_standing(world: World, found: Stance, seconds: float) -> str:
    verdict = "stands" if found.steady else "DOES NOT STAND"
    lines = [
        f"after {seconds:g} s it {verdict}: base at {found.height:.3f} m (base_height {world.robot.base_height:g} m),"
        f" inclined by {math.degrees(found.tilt):.1f} deg, {found.drift:.3f} m away, {found.speed:.3f} m/s"
    ]
    if found.saturated:
        lines.append(f"at their torque limits: {', '.join(found.saturated)}")
    if not world.robot.self_collision:
        lines.append("self_collision: none, the robot passes through itself")
    return "\n".join(lines)


def _on_contacts(world: World, found: Stance) -> str:
    feet = {geom for foot in world.robot.feet for geom in foot}
    lines = ["contacts (N):"]
    for (first, second), force in sorted(found.contacts.items()):
        is_foot = "ground" in (first, second) and bool({first, second} & feet)
        lines.append(f"  {first} - {second}: {force:.1f}{'' if is_foot else '  NOT A FOOT ON THE GROUND'}")
    return "\n".join(lines if found.contacts else ["contacts: none"])


def _on_joints(world: World, found: Stance) -> str:
    """A table in the order of actions."""
    robot, model, reach = world.robot, world.model, reached_limits(world)
    rows = [("action", "joint", "place in file", "default", "sag", "range", "reached", "")]
    for k, name in enumerate(robot.joints):
        joint = model.joint(name)
        limits, ends, note = ("none", "", "")
        if name in reach:
            (low, high), (lowest, highest) = joint.range.tolist(), reach[name]
            limits, ends = f"{low:.2f} .. {high:.2f}", f"{lowest:.2f} .. {highest:.2f}"
            note = "" if lowest - low < NEAR and high - highest < NEAR else "stops short"
        default, sag = robot.default_joint_pos[name], found.sag[name]
        rows.append((str(k), name, str(int(joint.id) - 1), f"{default:.3f}", f"{sag:+.3f}", limits, ends, note))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    table = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    driven = set(robot.joints)
    passive = [model.joint(k).name for k in range(1, model.njnt) if model.joint(k).name not in driven]
    return "\n".join(["joints (rad):", *table, *([f"passive: {', '.join(passive)}"] if passive else [])])


def _on_sight(sight: Sight, carrier: str) -> str:
    own = sum(sight.own.values())
    advice = "; a mount with a freer view is worth a try (lidar.mount=...)" if own > MANY_OWN else ""
    lines = [f"LiDAR on {carrier}: {100 * own:.1f} % of {sight.rays} rays hit the robot{advice}"]
    if sight.own:
        most = ", ".join(f"{name} {100 * share:.1f} %" for name, share in list(sight.own.items())[:8])
        lines.append(f"  nearest {sight.nearest:.3f} m; most often {most}")
    return "\n".join(lines)


command = Command(main, Arguments, __doc__, "of the robot and its sensor", (ValueError,), first="name")
