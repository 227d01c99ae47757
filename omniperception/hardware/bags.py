"""Recordings as a robot's messages, in order of time: an .mcap file, or a bag of ROS 2."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omniperception.deploy.description import DeployError
from omniperception.deploy.go2 import MOTORS
from omniperception.hardware.clouds import Points, read_custom_msg, read_point_cloud2
from omniperception.hardware.machine import Mode
from omniperception.hardware.messages import LOW_STATE

_CLOUDS: dict[str, Callable[[bytes], Points]] = {
    "sensor_msgs/msg/PointCloud2": read_point_cloud2,
    "livox_ros_driver2/msg/CustomMsg": read_custom_msg,
}
_LOW_STATE, _JOINTS, _IMU = "unitree_go/msg/LowState", "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
_TWISTS = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist")
_MODE, _MODES = "std_msgs/msg/String", tuple(Mode)
OUTPUTS = "/policy/"
"""Topics that begin so are what a policy has said."""


@dataclass(frozen=True)
class Message:
    """One of a recording.

    Attributes:
        topic: its name.
        kind: its type, such as sensor_msgs/msg/Imu.
        time_ns: when it was recorded.
        data: CDR.
        decode: gives an object with the type's fields.
    """

    topic: str
    kind: str
    time_ns: int
    data: bytes
    decode: Callable[[], Any]


@dataclass(frozen=True)
class Topics:
    """Which topics are read; None: the only one of its kind.

    Attributes:
        joints: LowState, or JointState where there is none.
        points: PointCloud2 or Livox CustomMsg.
        imu: of the base; not needed with LowState.
        command: Twist or TwistStamped.
    """

    joints: str | None = None
    points: str | None = None
    imu: str | None = None
    command: str | None = None


@dataclass(frozen=True)
class Event:
    """What a robot has heard, one of them.

    Attributes:
        time_s: since the recording began.
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


def messages(path: Path) -> Iterator[Message]:
    """All messages of a recording.

    Raises:
        DeployError: there is none, it cannot be read, or a library is missing.
    """
    if not path.exists():
        raise DeployError(
            f"{path} does not exist; an .mcap file, a .db3 file or the folder of a ROS 2 bag was expected"
        )
    read = _of_mcap if path.suffix == ".mcap" else _of_bag
    try:
        yield from read(path)
    except ModuleNotFoundError as error:
        extra = "robot" if path.suffix == ".mcap" else "clouds"
        raise DeployError(f"{path} needs {error.name}: pip install 'omniperception[{extra}]'") from None


def _of_mcap(path: Path) -> Iterator[Message]:
    import zstandard
    from mcap.exceptions import EndOfFile, McapError
    from mcap.reader import NonSeekingReader
    from mcap_ros2.decoder import DecoderFactory

    factory = DecoderFactory()
    with path.open("rb") as file:
        try:
            for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                if schema is not None:
                    decoder = factory.decoder_for(channel.message_encoding, schema)
                    data = message.data

                    def decode(decoder: Any = decoder, data: bytes = data) -> Any:
                        return decoder(data)

                    yield Message(channel.topic, schema.name, message.log_time, data, decode)
        except (EndOfFile, struct.error):
            print(f"{path} is cut off, as a killed process leaves it; read up to there", file=sys.stderr)
        except (McapError, zstandard.ZstdError, RuntimeError) as error:  # RuntimeError: lz4's
            raise DeployError(f"{path} is not a readable MCAP file: {error}") from None


def _of_bag(path: Path) -> Iterator[Message]:
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    folder = path.parent if path.suffix == ".db3" else path
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            if not bag.is2:
                raise DeployError(f"{path} is a bag of ROS 1; convert it: rosbags-convert --src {path} --dst FOLDER")
            for connection, time_ns, raw in bag.messages():

                def decode(kind: str = connection.msgtype, raw: bytes = bytes(raw)) -> Any:
                    return bag.deserialize(raw, kind)

                yield Message(connection.topic, connection.msgtype, time_ns, bytes(raw), decode)
    except (AnyReaderError, FileNotFoundError) as error:
        raise DeployError(f"{path} is not a readable bag: {str(error).splitlines()[0]}") from None


def events(path: Path, wanted: Topics) -> Iterator[Event]:
    """What a robot has heard, in order of the recording.

    Raises:
        DeployError: the recording lacks joints, their positions or velocities, or the base's orientation; or a topic
            has to be named.
    """
    kinds = {message.topic: message.kind for message in messages(path)}
    inputs = {topic: kind for topic, kind in kinds.items() if not topic.startswith(OUTPUTS)}
    states = [kind for kind in (_LOW_STATE, _JOINTS) if kind in inputs.values()]
    if not states:
        raise DeployError(f"{path}: joints were expected, a topic of type {_JOINTS} or {_LOW_STATE}; none is there")
    joints = _chosen(path, inputs, tuple(states if wanted.joints else states[:1]), wanted.joints, "joints")
    low = joints if joints is not None and inputs[joints] == _LOW_STATE else None
    imu = None if low else _chosen(path, inputs, (_IMU,), wanted.imu, "imu")
    if low is None and imu is None:
        raise DeployError(f"{path}: the base's orientation was expected, a topic of type {_IMU}; none is there")
    points = _chosen(path, inputs, tuple(_CLOUDS), wanted.points, "points")
    command = _chosen(path, inputs, _TWISTS, wanted.command, "commands")
    read = {"joints": joints, "orientation": low or imu, "points": points, "commands": command}
    print(
        f"{path}: " + ", ".join(f"{what} from {topic or 'no topic'}" for what, topic in read.items()), file=sys.stderr
    )
    assembled, begin, has_imu = LOW_STATE.zeros(), None, False
    for message in messages(path):
        begin = message.time_ns if begin is None else begin
        now, topic = 1e-9 * (message.time_ns - begin), message.topic
        if topic == low:
            yield Event(now, state=LOW_STATE.from_cdr(message.data))
        elif topic == imu:
            _take_imu(path, assembled, message.decode())
            has_imu = True
        elif topic == joints:
            _take_joints(path, assembled, message.decode())
            if has_imu:
                yield Event(now, state=assembled.copy())
        elif topic == points:
            yield Event(now, points=_CLOUDS[message.kind](message.data))
        elif topic == command:
            yield Event(now, command=_command(message.decode()))
        elif topic == "/mode" and message.kind == _MODE and (mode := message.decode().data).partition(":")[0] in _MODES:
            yield Event(now, mode=mode)
        elif topic == f"{OUTPUTS}joint_targets":
            yield Event(now, targets=_in_motors_order(path, message.decode(), "position"))


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
