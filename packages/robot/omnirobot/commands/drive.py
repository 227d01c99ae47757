"""Runs an exported policy on a Go2 with a Mid-360, or on `robot-sim`.

    robot policy=exported interface=eth0 host=192.168.1.50
    robot policy=exported points=packets host=127.0.0.1 steer=udp:9000      # with robot-sim on this machine

Read docs/guide/robot.md first: it says what was never tried on hardware. Two processes: the guard owns rt/lowcmd,
stands the robot up and lays it down, and damps its joints when something is wrong; this one gives it the policy's
targets.
The remote, always: L2+A stands up, start walks, L2+X lies down, L2+Y damps, L2+B is an e-stop until the program is
started again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omnirobot.common.cli import Command, argument, refuse_arguments
from omnirobot.drive.control import RobotConfig, run
from omnirobot.runtime.description import DeployError
from omnirobot.wire.clouds import Extrinsic
from omnirobot.wire.lidar import KINDS, LidarSource
from omnirobot.wire.switcher import CHOICES

_OF_PACKETS, _OF_TOPICS = ("host", "point_port"), ("topic", "extrinsic")
_UNREAD = {"none": (*_OF_PACKETS, *_OF_TOPICS), "mid360": _OF_TOPICS, "packets": _OF_TOPICS}
"""Arguments that say nothing for these `points`; for a topic, those of packets."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's arguments."""

    policy: Path = argument(Path("exported"), "folder that export has written")
    interface: str = argument("lo", "network interface of the robot's DDS; lo: this machine, with robot-sim")
    domain: int = argument(0, "of DDS", least=0)
    points: str = argument(
        "mid360",
        "where points come from: the sensor's packets after a search, or without one, or a driver's topic",
        choices=(*KINDS, "none"),
    )
    host: str = argument("192.168.1.50", "this machine's address in the sensor's network, of mid360 and packets")
    point_port: int = argument(56301, "UDP port that points come to, likewise", least=1)
    topic: str = argument("rt/livox/lidar", "topic of PointCloud2 or CustomMsg")
    extrinsic: str | None = argument(None, "x,y,z,qw,qx,qy,qz that a topic's driver has applied to the points; undone")
    steer: str = argument("remote", "remote, keyboard, udp:PORT, goal:X,Y[,SPEED] in odometry, or v_x,v_y,yaw_rate")
    crc: bool = argument(True, "whether states with a wrong checksum are refused; simulators that fill none need false")
    sport_mode: str = argument(
        "check", "the robot's own controller: refuse while it runs, end it, or do not ask", choices=CHOICES
    )
    record: Path | None = argument(None, "file ending in .mcap, of state, clouds and what the policy did; null: none")
    report: Path | None = argument(None, "file of what was measured; null: none", suffixes=(".json",))
    seconds: float | None = argument(None, "how long; null: until it is interrupted", positive=True)


def main(arguments: Arguments) -> None:
    """Runs, and prints what was measured."""
    unread = _UNREAD.get(arguments.points, _OF_PACKETS)
    refuse_arguments(arguments, unread, f"it is not read for points={arguments.points}")
    source = LidarSource(
        kind=arguments.points,
        topic=arguments.topic,
        host=arguments.host,
        point_port=arguments.point_port,
        extrinsic=_extrinsic(arguments.extrinsic),
    )
    config = RobotConfig(
        policy=arguments.policy,
        interface=arguments.interface,
        domain=arguments.domain,
        lidar=None if arguments.points == "none" else source,
        steer=arguments.steer,
        check_crc=arguments.crc,
        sport_mode=arguments.sport_mode,
        record=arguments.record,
        report=arguments.report,
        seconds=arguments.seconds,
    )
    print(run(config))


def _extrinsic(text: str | None) -> Extrinsic:
    try:
        numbers = [float(part) for part in (text or "0,0,0,1,0,0,0").split(",")]
        if len(numbers) != 7:
            raise ValueError
    except ValueError:
        raise DeployError(f"extrinsic={text}: 7 numbers were expected, x,y,z,qw,qx,qy,qz") from None
    return Extrinsic(numbers[:3], numbers[3:])


command = Command(main, Arguments, __doc__)
