"""Recordings of a run: an MCAP file with ROS 2 messages, which Foxglove, rerun and `replay-bag` open.

| topic | type | what |
|---|---|---|
| /joint_states, /imu | JointState, Imu | the state of each control step; joints in the motors' order |
| /lidar/points | PointCloud2 | points as they came, `t` nanoseconds after the stamp; misses are zero |
| /command | TwistStamped | what was asked for, before limits |
| /mode | String | the guard's mode, and why |
| /policy/points | PointCloud2 | the rays of a frame that the policy was given |
| /policy/obstacles | LaserScan | nearest of them by sector, between heights; geometry, not what the network thinks |
| /policy/joint_targets, /policy/action | JointState, Float32MultiArray | what the policy asked for, its raw output |
| /tf | TFMessage | base in `odom` (orientation alone), sensor in the base |

Topics under /policy are what came out; `replay-bag` reads the others.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omnirobot.common.ros import ros_types
from omnirobot.runtime.description import DeployError, Description
from omnirobot.runtime.geometry import sector_of
from omnirobot.runtime.go2 import MOTORS
from omnirobot.runtime.sampling import rotation_matrix, without_heading
from omnirobot.wire.clouds import Points

SECTORS = 36
HEIGHTS = (-0.15, 0.5)
"""m above the base, between which a point counts as an obstacle of /policy/obstacles."""
OWN = (0.5, 0.3)
"""m ahead and aside, within which a point is the robot's own and none."""
_CLOCK_JUMP_NS = 10**9
"""Where a sensor's clock is as far from the time at which its points come, it has jumped."""
_CHUNK_BYTES = 256 * 1024
"""A killed process loses as much as has not been written yet."""
TOPICS = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/imu": "sensor_msgs/msg/Imu",
    "/lidar/points": "sensor_msgs/msg/PointCloud2",
    "/command": "geometry_msgs/msg/TwistStamped",
    "/mode": "std_msgs/msg/String",
    "/policy/points": "sensor_msgs/msg/PointCloud2",
    "/policy/obstacles": "sensor_msgs/msg/LaserScan",
    "/policy/joint_targets": "sensor_msgs/msg/JointState",
    "/policy/action": "std_msgs/msg/Float32MultiArray",
    "/tf": "tf2_msgs/msg/TFMessage",
}


@dataclass(frozen=True)
class Step:
    """One control step.

    Attributes:
        time_s: on the loop's clock.
        state: () LOW_STATE.
        mode: the guard's, with its reason.
        command: (3,) m/s, m/s, rad/s.
        seen: (num_rays, 3) m, sensor frame, that the policy was given; None: no frame was complete.
        targets: (12,) rad, in the motors' order; None: the policy has stopped.
        action: (12,) its raw output.
        stopped: why the policy has stopped while it moved the robot; empty: it has not.
    """

    time_s: float
    state: np.ndarray
    mode: str
    command: np.ndarray
    seen: np.ndarray | None
    targets: np.ndarray | None
    action: np.ndarray
    stopped: str = ""


def nearest_by_sector(
    points: np.ndarray, base_quat: np.ndarray, mount_pos: Sequence[float], mount_quat: Sequence[float]
) -> np.ndarray:
    """(SECTORS,) m from the base's origin, horizontal, inf where nothing is; sector 0 begins straight behind.

    Args:
        points: (n, 3) m, sensor frame; misses are zero.
        base_quat: (4,) of the base, (w, x, y, z).
        mount_pos: of the sensor in the base, m.
        mount_quat: likewise.
    """
    places = levelled(points[points.any(axis=1)], base_quat, mount_pos, mount_quat)
    x, y, z = places.T
    inside = (z > HEIGHTS[0]) & (z < HEIGHTS[1]) & ((abs(x) > OWN[0]) | (abs(y) > OWN[1]))
    nearest = np.full(SECTORS, np.inf)
    np.minimum.at(nearest, sector_of(places[inside, :2], SECTORS), np.hypot(x, y)[inside])
    return nearest


def levelled(
    points: np.ndarray, base_quat: np.ndarray, mount_pos: Sequence[float], mount_quat: Sequence[float]
) -> np.ndarray:
    """(n, 3) m of points (n, 3) in the sensor frame: from the base's origin, x ahead, z upwards."""
    level = without_heading(rotation_matrix(base_quat))
    return (points @ rotation_matrix(mount_quat).T + np.asarray(mount_pos)) @ level.T


def make_folder(path: Path, argument: str) -> None:
    """Makes the folder of a file; `argument`: that names it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DeployError(f"{argument}={path}: its folder cannot be made: {error.strerror}") from None
    if path.is_dir():
        raise DeployError(f"{argument}={path} is a folder; give a file")


class Recorder:
    """Writes an MCAP file, in a thread of its own."""

    def __init__(self, path: Path, description: Description) -> None:
        """Args: path: of the file, whose folder is made; description: of the policy."""
        try:
            from mcap.writer import Writer
        except ImportError:
            raise DeployError("record= needs mcap: pip install 'omnirobot[recordings]'") from None
        if path.suffix != ".mcap":
            raise DeployError(f"record={path}: a file ending in .mcap was expected")
        make_folder(path, "record")
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise DeployError(f"record={path} exists; give another name") from None
        except OSError as error:
            raise DeployError(f"record={path} cannot be written: {error.strerror}") from None
        self._writer, self._types = Writer(self._file, chunk_size=_CHUNK_BYTES), ros_types()
        self._writer.start("ros2")
        self._channels, schemas = dict[str, int](), dict[str, int]()
        for topic, kind in TOPICS.items():
            if kind not in schemas:
                definition, _ = self._types.generate_msgdef(kind, ros_version=2)
                schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schemas[kind])
        self._lidar = description.lidar
        self._start_ns = time.time_ns()
        self._loop_start: float | None = None
        self._sensor_start: int | None = None
        self._mode = ""
        self._queue: queue.SimpleQueue[tuple[int, Points | Step] | None] = queue.SimpleQueue()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def points(self, now: float, points: Points) -> None:
        """Points (n, 3) m in the sensor's own frame, that have come at `now`, s on the loop's clock."""
        self._queue.put((self._wall_ns(now), points))

    def step(self, step: Step) -> None:
        """A control step."""
        self._queue.put((self._wall_ns(step.time_s), step))

    def _wall_ns(self, now: float) -> int:
        if self._loop_start is None:
            self._loop_start = now
        return self._start_ns + round(1e9 * (now - self._loop_start))

    def close(self) -> None:
        """Writes what is left.

        Raises:
            DeployError: something could not be written.
        """
        self._queue.put(None)
        self._thread.join()
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            self._error = self._error or error
        if self._error is not None:
            raise DeployError(f"the recording is incomplete: {self._error}")

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            if self._error is not None:
                continue
            try:
                time_ns, what = item
                self._write_points(time_ns, what) if isinstance(what, Points) else self._write_step(time_ns, what)
            except Exception as error:  # the robot walks on without a recording; close() tells
                self._error = error

    def _write(self, topic: str, time_ns: int, *parts: Any) -> None:
        """A message of these parts, in the order of its type's fields."""
        data = self._types.serialize_cdr(self._made(TOPICS[topic], *parts), TOPICS[topic])
        self._writer.add_message(self._channels[topic], time_ns, bytes(data), time_ns)

    def _made(self, kind: str, *parts: Any) -> Any:
        """A part of a message."""
        return self._types.types[kind](*parts)

    def _write_points(self, time_ns: int, points: Points) -> None:
        jumps = np.flatnonzero(np.abs(np.diff(points.times_ns)) > _CLOCK_JUMP_NS) + 1
        for part in np.split(np.arange(len(points.times_ns)), jumps):
            if len(part):
                self._write_timed(time_ns, points.points[part], points.times_ns[part])

    def _write_timed(self, time_ns: int, points: np.ndarray, times_ns: np.ndarray) -> None:
        newest = int(times_ns.max())
        if self._sensor_start is None or abs(newest + self._sensor_start - time_ns) > _CLOCK_JUMP_NS:
            self._sensor_start = time_ns - newest
        times = times_ns + self._sensor_start
        rows = np.zeros(len(times), [("xyz", "<f4", 3), ("t", "<u4")])
        rows["xyz"], rows["t"] = points, times - times.min()
        self._write_cloud("/lidar/points", time_ns, rows, int(times.min()))

    def _write_step(self, time_ns: int, step: Step) -> None:
        imu, motors = step.state["imu_state"], step.state["motor_state"][:12]
        base, quat, unknown = self._header(time_ns, "base"), self._quaternion(imu["quaternion"]), np.zeros(9)
        gyro, acceleration = self._vector(imu["gyroscope"]), self._vector(imu["accelerometer"])
        self._write("/imu", time_ns, base, quat, unknown, gyro, unknown, acceleration, unknown)
        if step.mode != self._mode:
            self._mode = step.mode
            self._write("/mode", time_ns, step.mode)
        linear, angular = self._vector((*step.command[:2], 0.0)), self._vector((0.0, 0.0, step.command[2]))
        self._write("/command", time_ns, base, self._made("geometry_msgs/msg/Twist", linear, angular))
        joints = [motors[name].astype(float) for name in ("q", "dq", "tau_est")]
        self._write("/joint_states", time_ns, base, list(MOTORS), *joints)
        if step.targets is not None:
            nothing = np.zeros(0)
            targets = np.asarray(step.targets, float)
            self._write("/policy/joint_targets", time_ns, base, list(MOTORS), targets, nothing, nothing)
            layout = self._made("std_msgs/msg/MultiArrayLayout", [], 0)
            self._write("/policy/action", time_ns, layout, step.action.astype(np.float32))
        transforms = [self._transform(self._header(time_ns, "odom"), "base", (0.0, 0.0, 0.0), imu["quaternion"])]
        if self._lidar is not None:
            transforms.append(self._transform(base, "lidar", self._lidar.mount_pos, self._lidar.mount_quat))
        self._write("/tf", time_ns, transforms)
        if step.seen is not None and self._lidar is not None:
            hits = step.seen[step.seen.any(axis=1)]
            rows = np.zeros(len(hits), [("xyz", "<f4", 3)])
            rows["xyz"] = hits
            self._write_cloud("/policy/points", time_ns, rows, time_ns)
            nearest = nearest_by_sector(hits, imu["quaternion"], self._lidar.mount_pos, self._lidar.mount_quat)
            width = 2 * math.pi / SECTORS
            angles = (-math.pi + width / 2, math.pi - width / 2, width)
            ranges = (0.0, float(self._lidar.max_range), nearest.astype(np.float32), np.zeros(0, np.float32))
            self._write("/policy/obstacles", time_ns, base, *angles, 0.0, 0.0, *ranges)

    def _write_cloud(self, topic: str, time_ns: int, rows: np.ndarray, stamp_ns: int) -> None:
        """Of records with `xyz` (float32) and perhaps `t` (uint32, ns)."""
        fields = [self._made("sensor_msgs/msg/PointField", axis, 4 * k, 7, 1) for k, axis in enumerate("xyz")]
        if "t" in (rows.dtype.names or ()):
            fields.append(self._made("sensor_msgs/msg/PointField", "t", 12, 6, 1))
        data, step = np.frombuffer(rows.tobytes(), np.uint8), rows.dtype.itemsize
        header = self._header(stamp_ns, "lidar")
        self._write(topic, time_ns, header, 1, len(rows), fields, False, step, len(data), data, True)

    def _header(self, time_ns: int, frame: str) -> Any:
        stamp = self._made("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
        return self._made("std_msgs/msg/Header", stamp, frame)

    def _vector(self, values: Iterable[float]) -> Any:
        return self._made("geometry_msgs/msg/Vector3", *map(float, values))

    def _quaternion(self, values: Iterable[float]) -> Any:
        """Of (w, x, y, z)."""
        w, *xyz = map(float, values)
        return self._made("geometry_msgs/msg/Quaternion", *xyz, w)

    def _transform(self, header: Any, child: str, pos: Iterable[float], quat: Iterable[float]) -> Any:
        transform = self._made("geometry_msgs/msg/Transform", self._vector(pos), self._quaternion(quat))
        return self._made("geometry_msgs/msg/TransformStamped", header, child, transform)
