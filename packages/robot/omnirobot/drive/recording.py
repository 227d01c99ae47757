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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omnirobot.runtime.description import DeployError, Description
from omnirobot.runtime.geometry import sector_of
from omnirobot.runtime.go2 import MOTORS
from omnirobot.runtime.sampling import rotation_matrix
from omnirobot.wire.clouds import Points

SECTORS = 36
HEIGHTS = (-0.15, 0.5)
"""m above the base, between which a point counts as an obstacle of /policy/obstacles."""
OWN = (0.5, 0.3)
"""m ahead and aside, within which a point is the robot's own and none."""
_SEPARATOR = "=" * 80 + "\n"
_CLOCK_JUMP_NS = 10**9
"""Where a sensor's clock is as far from the time at which its points come, it has jumped."""
_CHUNK_BYTES = 256 * 1024
"""A killed process loses as much as has not been written yet."""
_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
}
_KINDS = {
    "std_msgs/msg/String": "string data\n",
    "std_msgs/msg/Float32MultiArray": "std_msgs/MultiArrayLayout layout\nfloat32[] data\n",
    "geometry_msgs/msg/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist\n",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "sensor_msgs/msg/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
    ),
    "sensor_msgs/msg/LaserScan": (
        "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n"
        "float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\n"
        "float32[] ranges\nfloat32[] intensities\n"
    ),
    "sensor_msgs/msg/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
}
"""Fields of ROS 2's messages (common_interfaces)."""
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


def definition(kind: str) -> str:
    """A type's fields and those of the types in it, as MCAP wants them."""
    text, todo, done = _KINDS[kind], [_KINDS[kind]], set()
    while todo:
        for line in todo.pop().splitlines():
            part = line.split()[0].partition("[")[0]
            if part in _PARTS and part not in done:
                done.add(part)
                todo.append(_PARTS[part])
                text += f"{_SEPARATOR}MSG: {part}\n{_PARTS[part]}"
    return text


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
    """

    time_s: float
    state: np.ndarray
    mode: str
    command: np.ndarray
    seen: np.ndarray | None
    targets: np.ndarray | None
    action: np.ndarray


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
    w, x, y, z = np.asarray(base_quat, float)
    yaw = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    back = rotation_matrix((math.cos(yaw / 2), 0.0, 0.0, -math.sin(yaw / 2)))
    turn = back @ rotation_matrix((w, x, y, z))
    return (points @ rotation_matrix(mount_quat).T + np.asarray(mount_pos)) @ turn.T


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
            from mcap_ros2.writer import Writer
        except ImportError:
            raise DeployError("record= needs mcap-ros2-support: pip install 'omnirobot[recordings]'") from None
        if path.suffix != ".mcap":
            raise DeployError(f"record={path}: a file ending in .mcap was expected")
        make_folder(path, "record")
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise DeployError(f"record={path} exists; give another name") from None
        except OSError as error:
            raise DeployError(f"record={path} cannot be written: {error.strerror}") from None
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
        kinds = set(TOPICS.values())
        schemas = {kind: self._writer.register_msgdef(kind, definition(kind)) for kind in sorted(kinds)}
        self._schemas = {topic: schemas[kind] for topic, kind in TOPICS.items()}
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

    def stop(self, now: float, why: str) -> None:
        """The policy has stopped; its step, which has no targets, says so too."""

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

    def _write(self, topic: str, time_ns: int, message: dict[str, Any]) -> None:
        self._writer.write_message(topic, self._schemas[topic], message, log_time=time_ns)

    def _write_points(self, time_ns: int, points: Points) -> None:
        jumps = np.flatnonzero(np.abs(np.diff(points.times_ns)) > _CLOCK_JUMP_NS) + 1
        for part in np.split(np.arange(len(points.times_ns)), jumps):
            if len(part):
                self._write_cloud(time_ns, points.points[part], points.times_ns[part])

    def _write_cloud(self, time_ns: int, points: np.ndarray, times_ns: np.ndarray) -> None:
        newest = int(times_ns.max())
        if self._sensor_start is None or abs(newest + self._sensor_start - time_ns) > _CLOCK_JUMP_NS:
            self._sensor_start = time_ns - newest
        times = times_ns + self._sensor_start
        rows = np.zeros(len(times), [("xyz", "<f4", 3), ("t", "<u4")])
        rows["xyz"], rows["t"] = points, times - times.min()
        self._write("/lidar/points", time_ns, _cloud(rows, int(times.min()), "lidar"))

    def _write_step(self, time_ns: int, step: Step) -> None:
        imu, motors = step.state["imu_state"], step.state["motor_state"][:12]
        base = _header(time_ns, "base")
        quat = imu["quaternion"].tolist()
        self._write("/imu", time_ns, _imu(base, quat, imu["gyroscope"].tolist(), imu["accelerometer"].tolist()))
        if step.mode != self._mode:
            self._mode = step.mode
            self._write("/mode", time_ns, {"data": step.mode})
        command = step.command.tolist()
        twist = {"linear": _vector((*command[:2], 0.0)), "angular": _vector((0.0, 0.0, command[2]))}
        self._write("/command", time_ns, {"header": base, "twist": twist})
        joints = [motors[name].astype(float).tolist() for name in ("q", "dq", "tau_est")]
        self._write("/joint_states", time_ns, _joints(base, *joints))
        self._write_outputs(time_ns, base, quat, step)

    def _write_outputs(self, time_ns: int, base: dict, quat: list[float], step: Step) -> None:
        if step.targets is not None:
            self._write("/policy/joint_targets", time_ns, _joints(base, step.targets.tolist(), [], []))
            layout = {"dim": [], "data_offset": 0}
            self._write("/policy/action", time_ns, {"layout": layout, "data": step.action.tolist()})
        transforms = [_transform(_header(time_ns, "odom"), "base", (0.0, 0.0, 0.0), quat)]
        if self._lidar is not None:
            transforms.append(_transform(base, "lidar", self._lidar.mount_pos, self._lidar.mount_quat))
        self._write("/tf", time_ns, {"transforms": transforms})
        if step.seen is None or self._lidar is None:
            return
        rows = np.zeros(len(step.seen), [("xyz", "<f4", 3)])
        rows["xyz"] = step.seen
        self._write("/policy/points", time_ns, _cloud(rows[step.seen.any(axis=1)], time_ns, "lidar"))
        nearest = nearest_by_sector(step.seen, np.array(quat), self._lidar.mount_pos, self._lidar.mount_quat)
        self._write("/policy/obstacles", time_ns, _scan(base, nearest, self._lidar.max_range))


def _header(time_ns: int, frame: str) -> dict:
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": frame}


def _vector(values: Sequence[float]) -> dict:
    return dict(zip("xyz", map(float, values), strict=True))


def _quaternion(values: Sequence[float]) -> dict:
    """Of (w, x, y, z)."""
    return dict(zip("wxyz", map(float, values), strict=True))


def _joints(header: dict, position: list, velocity: list, effort: list) -> dict:
    return {"header": header, "name": list(MOTORS), "position": position, "velocity": velocity, "effort": effort}


def _imu(header: dict, quat: list, gyro: list, acceleration: list) -> dict:
    unknown = [0.0] * 9
    return {
        "header": header,
        "orientation": _quaternion(quat),
        "orientation_covariance": unknown,
        "angular_velocity": _vector(gyro),
        "angular_velocity_covariance": unknown,
        "linear_acceleration": _vector(acceleration),
        "linear_acceleration_covariance": unknown,
    }


def _transform(header: dict, child: str, pos: Sequence[float], quat: Sequence[float]) -> dict:
    transform = {"translation": _vector(pos), "rotation": _quaternion(quat)}
    return {"header": header, "child_frame_id": child, "transform": transform}


def _scan(header: dict, nearest: np.ndarray, max_range: float) -> dict:
    width = 2 * math.pi / SECTORS
    return {
        "header": header,
        "angle_min": -math.pi + width / 2,
        "angle_max": math.pi - width / 2,
        "angle_increment": width,
        "time_increment": 0.0,
        "scan_time": 0.0,
        "range_min": 0.0,
        "range_max": float(max_range),
        "ranges": nearest.tolist(),
        "intensities": [],
    }


def _cloud(rows: np.ndarray, time_ns: int, frame: str) -> dict:
    """Of records with `xyz` (float32) and perhaps `t` (uint32, ns)."""
    fields = [{"name": axis, "offset": 4 * k, "datatype": 7, "count": 1} for k, axis in enumerate("xyz")]
    if "t" in (rows.dtype.names or ()):
        fields.append({"name": "t", "offset": 12, "datatype": 6, "count": 1})
    step = rows.dtype.itemsize
    return {
        "header": _header(time_ns, frame),
        "height": 1,
        "width": len(rows),
        "fields": fields,
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * len(rows),
        "data": rows.tobytes(),
        "is_dense": True,
    }
