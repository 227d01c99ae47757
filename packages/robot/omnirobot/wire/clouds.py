"""LiDAR messages of drivers, and frames that are cut out of a stream of points by their times."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnirobot.runtime.description import DeployError
from omnirobot.runtime.sampling import rotation_matrix
from omnirobot.wire import custom_msg
from omnirobot.wire.saying import say
from omnirobot.wire.sensor_clock import BACK_NS, SensorClock

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's names of PointField's datatypes INT8 to FLOAT64, without byte order."""


@dataclass(frozen=True)
class Points:
    """Points with the time of their measurement.

    Attributes:
        points: (n, 3) float32 m; misses are zero.
        times_ns: (n,) int64, on the sensor's or driver's clock.
    """

    points: np.ndarray
    times_ns: np.ndarray


@dataclass(frozen=True)
class Frame:
    """What a sensor measured within one period.

    Attributes:
        points: (n, 3) float32 m, sensor frame; misses are zero or left out.
        offsets_s: (n,) since `start_ns`.
        start_ns: beginning of the period.
    """

    points: np.ndarray
    offsets_s: np.ndarray
    start_ns: int


@dataclass(frozen=True)
class Extrinsic:
    """Where a driver says that the sensor is: it has given rotation * point + translation; undone before use.

    Attributes:
        pos: m.
        quat: (w, x, y, z).
    """

    pos: Sequence[float] = (0.0, 0.0, 0.0)
    quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (np.isfinite([*self.pos, *self.quat]).all() and np.any(self.quat)):
            raise DeployError(
                f"extrinsic of x,y,z {list(self.pos)} and qw,qx,qy,qz {list(self.quat)}: finite numbers were expected,"
                " and a quaternion other than 0"
            )

    def undo(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) float32 in the sensor's own frame; a point that is zero was no point, and a moved zero becomes one."""
        miss = ~points.any(axis=1)
        turn = rotation_matrix(self.quat)
        own = ((points - np.asarray(self.pos)) @ turn).astype(np.float32)
        own[miss | (np.linalg.norm(own, axis=1) < 1e-4)] = 0.0
        return own


def without_noise(points: np.ndarray, tags: np.ndarray) -> np.ndarray:
    """(n, 3) with points that a Mid-360 does not call normal made misses; tags: (n,) uint8.

    Two bits each say how certain a point is: 0 and 1 where it may stick between adjacent objects, 2 and 3 for rain, fog
    and dust, 4 and 5 for other reasons; 0 is high (a normal point), 1 medium, 2 low. So says Livox's "Communication
    Protocol--Mid360", Tag Information (github.com/Livox-SDK/livox_wiki_en). Another sensor's tags mean other things.
    """
    noise = (tags & 0x3F) != 0
    return np.where(noise[:, None], np.float32(0.0), points)


def in_one_time(message: Points) -> Points:
    """The message, whose points were measured within a second of each other; a DeployError otherwise."""
    span_s = 1e-9 * float(np.ptp(message.times_ns)) if len(message.times_ns) else 0.0
    if span_s > 1.0:
        raise DeployError(f"a message's points span {span_s:.3g} s, at most 1 s was expected; see the driver's times")
    return message


SLACK_NS = 2_000_000
"""By which messages may be out of order."""
MOST_HELD = 1_000_000
"""Points that wait for their frame's end; a Mid-360 measures so many in 5 s."""


class FrameCutter:
    """Cuts frames out of points by their times, whatever the messages are in which they come.

    A frame is given out when a point has come that is `SLACK_NS` younger than its end, so that messages may overtake
    each other by as much. Where time jumps, cutting starts again.

    Attributes:
        clock: what has become of times that are wrong, where it is known when messages came.
        late: points that came after their frame had been given out.
        jumps: how often the time of points jumped, backwards or ahead by more than a second.
        dropped: points of frames that such a jump, or times that do not go on, left unfinished.
    """

    def __init__(self, period_s: float) -> None:
        self._period = round(period_s * 1e9)
        self.clock = SensorClock()
        self.late = self.jumps = self.dropped = self._waiting = 0
        self._has_said = False
        self._restart()

    def _restart(self) -> None:
        self.dropped += self._waiting
        self._start: int | None = None
        self._held: list[Points] = []
        self._waiting = 0

    def add(self, given: Points, now: float | None = None) -> list[Frame]:
        """Frames that are complete, oldest first; periods without any point give none.

        Args:
            given: a message's points.
            now: when it came, s, on a clock that goes on evenly; None: its times are believed.
        """
        if not len(given.times_ns):
            return []
        first, last = int(given.times_ns.min()), int(given.times_ns.max())
        times_ns = given.times_ns if now is None else self.clock.read(given.times_ns, first, last, now)
        if times_ns is not given.times_ns:
            given, first, last = Points(given.points, times_ns), int(times_ns.min()), int(times_ns.max())
        if self.clock.is_changed:
            self._restart()
        if self._start is not None and self._jumps(first, last, self._start):
            if not self.jumps:
                say(f"LiDAR: the points' time jumps by {1e-9 * (first - self._start):.3g} s: a new frame begins")
            self.jumps += 1
            self._restart()
        if self._start is None:
            self._start = first
        self.late += int((given.times_ns < self._start).sum())
        self._held.append(given)
        self._waiting += len(given.points)
        frames = []
        while last >= self._start + self._period + SLACK_NS:
            frames += self._cut()
        if self._waiting > MOST_HELD:
            if not self._has_said:
                self._has_said = True
                passed_s = 1e-9 * (last - self._start)
                say(f"LiDAR: the points' times went on by {passed_s:g} s in {self._waiting} points, which are dropped")
            self._restart()
        return frames

    def counts(self) -> dict[str, int]:
        """What went wrong so far, by name."""
        counts = {"late points": self.late, "points dropped": self.dropped, "jumps of time": self.jumps}
        return counts | {"messages timed by their arrival": self.clock.untimed}

    def _jumps(self, first: int, last: int, start: int) -> bool:
        """Whether a message from first to last, ns, is none of the frame that began at `start` or of those near it."""
        is_behind = last < start - BACK_NS or first <= start - 10**9
        return is_behind or last >= start + self._period + 10**9

    def _cut(self) -> list[Frame]:
        assert self._start is not None
        points = np.concatenate([held.points for held in self._held])
        times = np.concatenate([held.times_ns for held in self._held])
        start, end = self._start, self._start + self._period
        now, rest = (times >= start) & (times < end), times >= end
        if not now.any():  # empty periods are passed over at once
            end += (int(times[rest].min()) - end) // self._period * self._period
        self._start, self._held, self._waiting = end, [Points(points[rest], times[rest])], int(rest.sum())
        if not now.any():
            return []
        order = np.argsort(times[now], kind="stable")
        return [Frame(points[now][order], (times[now][order] - start) * 1e-9, start)]


class _Cdr:
    """Reads little-endian CDR after its four bytes of header."""

    def __init__(self, data: bytes, name: str) -> None:
        if data[:2] != b"\x00\x01":
            raise DeployError(f"{name}: little-endian CDR was expected, {data[:4].hex()} given")
        self.data, self.at = memoryview(data)[4:], 0

    def read(self, kind: str) -> int:
        size = struct.calcsize(kind)
        self.at = -(-self.at // size) * size
        (value,) = struct.unpack_from("<" + kind, self.data, self.at)
        self.at += size
        return value

    def text(self) -> str:
        return bytes(self.bytes()).rstrip(b"\0").decode("utf-8", "replace")

    def bytes(self) -> memoryview:
        length = self.read("I")
        part = self.data[self.at : self.at + length]
        if len(part) != length:
            raise struct.error("cut off")
        self.at += length
        return part


_TIME_FIELDS = ("timestamp", "offset_time", "time", "t")
LATEST_NS = 2**62
"""146 years; no clock of a sensor is there, and the sum of two such times fits int64."""


def read_point_cloud2(data: bytes) -> Points:
    """Points of a sensor_msgs/PointCloud2, in which every point has a time; nan becomes a miss.

    `timestamp` is livox_ros_driver2's: float64 nanoseconds. Integer `offset_time` or `t` are nanoseconds, float `time`
    seconds, after the header's stamp.

    Raises:
        DeployError: the message is cut off, big-endian, lacks x, y, z or a time, or has times that are not
            finite or that no clock shows.
    """
    try:
        return _point_cloud2(data)
    except DeployError:
        raise
    except (struct.error, TypeError, ValueError) as error:
        raise DeployError(f"PointCloud2: {error}") from None


def _point_cloud2(data: bytes) -> Points:
    cdr = _Cdr(data, "PointCloud2")
    stamp = cdr.read("i") * 10**9 + cdr.read("I")
    cdr.text()
    height, width = cdr.read("I"), cdr.read("I")
    fields = {}
    for _ in range(cdr.read("I")):
        name, offset, kind, _ = cdr.text(), cdr.read("I"), cdr.read("B"), cdr.read("I")
        fields[name] = ("<" + _TYPES[kind] if kind in _TYPES else "V1", offset)
    big_endian, step, row_step = cdr.read("B"), cdr.read("I"), cdr.read("I")
    time_field = next((name for name in _TIME_FIELDS if name in fields), None)
    if big_endian or not {"x", "y", "z"} <= set(fields) or time_field is None:
        raise DeployError(
            f"PointCloud2: little-endian fields x, y, z and one of {', '.join(_TIME_FIELDS)} were expected,"
            f" {', '.join(fields) or 'none'} given; frames are cut by the points' times"
        )
    names = ["x", "y", "z", time_field, *(["tag"] if "tag" in fields else [])]
    dtype = np.dtype(
        {
            "names": names,
            "formats": [fields[name][0] for name in names],
            "offsets": [fields[name][1] for name in names],
            "itemsize": step,
        }
    )
    if any(dtype[name].kind == "V" for name in names):
        raise DeployError(f"PointCloud2: numbers were expected in {', '.join(names)}")
    padded = height > 1 and row_step > width * step
    strides = (row_step if padded else width * step, step)
    rows = np.ndarray((height, width), dtype, cdr.bytes(), strides=strides).reshape(-1)
    points = np.stack([rows[axis].astype(np.float32) for axis in "xyz"], 1)
    points[~np.isfinite(points).all(axis=1)] = 0.0
    times = rows[time_field]
    if times.dtype.kind == "f":
        latest = LATEST_NS * (1.0 if time_field == "timestamp" else 1e-9)
        wrong = times[~(abs(times.astype(np.float64)) < latest)]
        if wrong.size:
            raise DeployError(f"PointCloud2: finite numbers were expected in {time_field}, {wrong[0]!r} given")
    if time_field == "timestamp":
        if times.dtype.kind == "f" and (times != np.floor(times)).any():
            raise DeployError(
                f"PointCloud2: timestamp in nanoseconds, as of livox_ros_driver2, was expected, {times[0]!r} given"
            )
        times_ns = times.astype(np.int64)
    elif times.dtype.kind == "f":
        times_ns = stamp + np.rint(times.astype(np.float64) * 1e9).astype(np.int64)
    else:
        times_ns = stamp + times.astype(np.int64)
    return Points(without_noise(points, rows["tag"].astype(np.uint8)) if "tag" in fields else points, times_ns)


def read_custom_msg(data: bytes) -> Points:
    """Points of Livox's CustomMsg."""
    try:
        given = custom_msg.read(data)
    except ValueError as error:
        raise DeployError(str(error)) from None
    if given.base_ns >= LATEST_NS:
        raise DeployError(f"CustomMsg: a timebase in nanoseconds was expected, {given.base_ns} given")
    points = np.stack([given.points[axis] for axis in "xyz"], 1)
    times_ns = given.base_ns + given.points["offset_time"].astype(np.int64)
    return Points(without_noise(points, given.points["tag"]), times_ns)
