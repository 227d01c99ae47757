"""Runs an exported policy on a recording, open loop, and draws what it saw and would have done.

    robot policy=exported record=run.mcap ...
    replay-bag run.mcap policy=exported                      # a recording of ours
    replay-bag bags/walk command=0.5,0,0 points=/livox/lidar # a bag of ROS 2, its folder or a .db3 file, or of ROS 1

A recording needs the robot's joints and the base's orientation (unitree_go LowState, or JointState with a Go2's names
and Imu), and clouds whose points have times (PointCloud2 or Livox CustomMsg) if the policy sees. Commands are read from
a Twist or TwistStamped, unless command is given; there are none: the robot is told to stand. Whatever the policy asks
for, the robot of the recording does not follow: the longer ago the two parted, the less its answers mean.

Nothing of ROS is needed; bags other than .mcap files need the extra clouds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnirobot.common.cli import PICTURES, Command, argument
from omnirobot.replay.bags import Topics, events
from omnirobot.replay.replay import draw, replay
from omnirobot.runtime import DeployError, ExportedPolicy


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's arguments."""

    file: Path = argument(doc=".mcap, .db3 or .bag file, or folder of a ROS 2 bag")
    policy: Path = argument(Path("exported"), "folder that export has written")
    joints: str | None = argument(
        None, "topic of the joints, LowState or JointState; null: the only one, LowState first"
    )
    points: str | None = argument(None, "topic of the clouds; null: the only one")
    imu: str | None = argument(None, "topic of the base's Imu; null: the only one")
    commands: str | None = argument(None, "topic of the commands; null: the only one")
    command: str | None = argument(None, "v_x,v_y,yaw_rate in place of the recorded ones")
    out: Path | None = argument(None, "picture; null: the recording's name, ending in .png", suffixes=PICTURES)


def main(arguments: Arguments) -> None:
    """Replays, prints and draws."""
    recording = arguments.file.resolve()  # a folder may be ".", or have a dot in its name
    path = arguments.out or recording.with_name(f"{recording.name if recording.is_dir() else recording.stem}.png")
    policy = ExportedPolicy.load(arguments.policy)
    sees = policy.description.perception is not None and policy.description.lidar is not None
    topics = Topics(arguments.joints, arguments.points, arguments.imu, arguments.commands, sees)
    replayed = replay(policy, events(arguments.file, topics), _command(arguments.command))
    print(replayed)
    draw(replayed, policy, path)
    print(f"written: {path}")


def _command(text: str | None) -> np.ndarray | None:
    if text is None:
        return None
    try:
        numbers = np.array([float(part) for part in text.split(",")])
        if numbers.shape != (3,) or not np.isfinite(numbers).all():
            raise ValueError
    except ValueError:
        raise DeployError(f"command={text}: three numbers were expected, v_x,v_y,yaw_rate") from None
    return numbers


command = Command(main, Arguments, __doc__, first="file")
