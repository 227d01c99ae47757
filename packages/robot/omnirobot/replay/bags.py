"""Recordings as a robot's messages, in the order in which they were written: .mcap files, bags of ROS 2 and 1."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omnirobot.drive.machine import Mode
from omnirobot.replay.recordings import Message, Recording
from omnirobot.runtime.description import DeployError
from omnirobot.runtime.go2 import MOTORS
from omnirobot.wire import custom_msg
from omnirobot.wire.clouds import Points, in_one_time, read_custom_msg, read_point_cloud2
from omnirobot.wire.messages import LOW_STATE

_POINT_CLOUD2, _CUSTOM_MSG = "sensor_msgs/msg/PointCloud2", "livox_ros_driver2/msg/CustomMsg"
_LOW_STATE, _JOINTS, _IMU = "unitree_go/msg/LowState", "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
_TWISTS = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist")
_MODE, _MODES = "std_msgs/msg/String", tuple(Mode)
OUTPUTS = "/policy/"
"""Topics that begin so are what a policy has said."""


@dataclass(frozen=True)
class Topics:
    """Which topics are read; None: the only one of its kind.

    Attributes:
        joints: LowState, or JointState where there is none.
        points: PointCloud2 or Livox CustomMsg.
        imu: of the base; not needed with LowState.
        command: Twist or TwistStamped.
        sees: whether points are needed.
    """

    joints: str | None = None
    points: str | None = None
    imu: str | None = None
    command: str | None = None
    sees: bool = False


@dataclass(frozen=True)
class Event:
    """What a robot has heard, one of them.

    Attributes:
        time_s: since the first message that is read.
        state: () LOW_STATE.
        points: of the LiDAR.
        command: (3,) m/s, m/s, rad/s.
        mode: the guard's.
        targets: (12,) rad, that the policy of then asked for, in the motors' order.
    """

    time_s: float
    state: np.ndarray | None = None
    points: Points | None = None
    command: np.ndarray | None = None
    mode: str | None = None
    targets: np.ndarray | None = None


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """What is wrong with a recording, as a DeployError."""
    if not path.exists():
        raise DeployError(
            f"{path} does not exist; an .mcap, .db3 or .bag file or the folder of a ROS 2 bag was expected"
        )
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        raise DeployError(f"{path} needs {library}: pip install 'omnirobot[recordings]'") from None
    except ValueError as error:
        raise DeployError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    except OSError as error:
        raise DeployError(f"{path} cannot be read: {error.strerror}") from None


def events(path: Path, wanted: Topics) -> Iterator[Event]:
    """What a robot has heard, in the order of the recording.

    A message of points that cannot be read, or whose points were measured more than a second apart, is left out, as on
    the robot; one line on standard error says so.

    Raises:
        DeployError: the recording lacks joints, their positions or velocities, the base's orientation, or points where
            they are needed; or a topic has to be named.
    """
    with _one_line(path):
        recording = Recording(path)
        inputs = {topic: kind for topic, kind in recording.topics.items() if not topic.startswith(OUTPUTS)}
        try:
            read = _inputs(path, inputs, wanted)
        except DeployError as error:
            raise DeployError(f"{error}{recording.missing}") from None
        print(
            f"{path}: " + ", ".join(f"{what} from {topic or 'no topic'}" for what, topic in read.items()),
            file=sys.stderr,
        )
        yield from _events(path, recording, read, wanted.sees)


def _inputs(path: Path, topics: dict[str, str], wanted: Topics) -> dict[str, str | None]:
    """The topic of each input, None where there is none."""
    states = [kind for kind in (_LOW_STATE, _JOINTS) if kind in topics.values()]
    if not states:
        raise DeployError(f"{path}: joints were expected, a topic of type {_JOINTS} or {_LOW_STATE}; none is there")
    joints = _chosen(path, topics, tuple(states if wanted.joints else states[:1]), wanted.joints, "joints")
    low = joints if joints is not None and topics[joints] == _LOW_STATE else None
    imu = None if low else _chosen(path, topics, (_IMU,), wanted.imu, "imu")
    if low is None and imu is None:
        raise DeployError(f"{path}: the base's orientation was expected, a topic of type {_IMU}; none is there")
    of_livox = (kind for kind in topics.values() if custom_msg.KIND.fullmatch(kind))
    clouds = tuple(dict.fromkeys((_POINT_CLOUD2, _CUSTOM_MSG, *of_livox)))
    points = _chosen(path, topics, clouds, wanted.points, "points")
    if points is None and wanted.sees:
        there = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items())
        raise DeployError(
            f"{path}: the policy needs points, a topic of type {_POINT_CLOUD2} or Livox's CustomMsg; there are {there}"
        )
    command = _chosen(path, topics, _TWISTS, wanted.command, "commands")
    return {"joints": joints, "orientation": low or imu, "points": points, "commands": command}


def _events(path: Path, recording: Recording, read: dict[str, str | None], sees: bool) -> Iterator[Event]:
    assembled, begin, has_imu = LOW_STATE.zeros(), None, False
    refused: list[str] = []
    clouds, targets = 0, f"{OUTPUTS}joint_targets"
    for message in recording.messages([*filter(None, read.values()), "/mode", targets]):
        begin = message.time_ns if begin is None else begin
        now, topic = 1e-9 * (message.time_ns - begin), message.topic
        if topic == read["joints"] == read["orientation"]:
            yield Event(now, state=LOW_STATE.from_cdr(message.data))
        elif topic == read["orientation"]:
            _take_imu(path, assembled, message.decode())
            has_imu = True
        elif topic == read["joints"]:
            _take_joints(path, assembled, message.decode())
            if has_imu:
                yield Event(now, state=assembled.copy())
        elif topic == read["points"]:
            clouds += 1
            try:
                yield Event(now, points=_points(message))
            except DeployError as error:
                refused.append(str(error))
        elif topic == read["commands"]:
            yield Event(now, command=_command(message.decode()))
        elif topic == "/mode" and message.kind == _MODE and (mode := message.decode().data).partition(":")[0] in _MODES:
            yield Event(now, mode=mode)
        elif topic == targets:
            yield Event(now, targets=_in_motors_order(path, message.decode(), "position"))
    if refused:
        said = f"{path}: {len(refused)} of {clouds} messages of {read['points']} refused, the first: {refused[0]}"
        if sees and len(refused) == clouds:
            raise DeployError(said)
        print(said, file=sys.stderr)


def _points(message: Message) -> Points:
    return in_one_time((read_point_cloud2 if message.kind == _POINT_CLOUD2 else read_custom_msg)(message.data))


def _chosen(path: Path, topics: dict[str, str], kinds: tuple[str, ...], name: str | None, key: str) -> str | None:
    """The topic of these types that is named, or the only one."""
    found = [topic for topic, kind in topics.items() if kind in kinds]
    if name is None and len(found) <= 1:
        return found[0] if found else None
    if name in found:
        return name
    there = ", ".join(found) or "none"
    raise DeployError(
        f"{path}: {name or 'several'} given, of type {' or '.join(kinds)} are {there}; name one with {key}="
    )


def _take_imu(path: Path, state: np.ndarray, message: Any) -> None:
    if message.orientation_covariance[0] == -1:
        raise DeployError(
            f"{path}: the base's orientation was expected, an {_IMU} with an orientation_covariance of -1 says that it"
            " has none; name another with imu="
        )
    imu, quat = state["imu_state"], message.orientation
    imu["quaternion"] = (quat.w, quat.x, quat.y, quat.z)
    for name, vector in (("gyroscope", message.angular_velocity), ("accelerometer", message.linear_acceleration)):
        imu[name] = (vector.x, vector.y, vector.z)


def _take_joints(path: Path, state: np.ndarray, message: Any) -> None:
    motors = state["motor_state"][:12]
    for name, field in (("q", "position"), ("dq", "velocity"), ("tau_est", "effort")):
        motors[name] = _in_motors_order(path, message, field)


def _in_motors_order(path: Path, message: Any, field: str) -> np.ndarray:
    """(12,) of a JointState; zeros where it gives no effort."""
    values = np.asarray(getattr(message, field), float)
    names = list(message.name)
    lacking = sorted(set(MOTORS) - set(names))
    if lacking:
        raise DeployError(
            f"{path}: joints of a Go2 were expected, {', '.join(lacking[:3])} are not among {names[:3]} ..."
        )
    if not len(values) and field == "effort":
        return np.zeros(len(MOTORS))
    if len(values) != len(names):
        raise DeployError(
            f"{path}: {len(names)} joints are named, and {field} has {len(values)} numbers; as many are needed"
        )
    return values[[names.index(name) for name in MOTORS]]


def _command(message: Any) -> np.ndarray:
    twist = getattr(message, "twist", message)
    return np.array([twist.linear.x, twist.linear.y, twist.angular.z])
