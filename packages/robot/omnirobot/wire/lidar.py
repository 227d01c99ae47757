"""Where frames come from on a robot: the Mid-360 itself, or a driver's topic."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from omnirobot.runtime.description import DeployError, Lidar
from omnirobot.wire.clouds import (
    Extrinsic,
    Frame,
    FrameCutter,
    Points,
    in_one_time,
    read_custom_msg,
    read_point_cloud2,
    without_noise,
)
from omnirobot.wire.dds import CUSTOM_MSG, POINT_CLOUD2, Network, Reader
from omnirobot.wire.livox import HOST_POINT_PORT, Mid360
from omnirobot.wire.saying import say


@dataclass(frozen=True)
class LidarSource:
    """Where points come from.

    Attributes:
        kind: 'mid360' (its own packets, after it has been found and pointed here), 'packets' (the same, but already
            pointed here), 'PointCloud2' or 'CustomMsg' (a topic over DDS).
        topic: of DDS.
        host: this machine's address in the sensor's network, of 'mid360' and 'packets'.
        point_port: of this machine, where packets come to.
        extrinsic: what a driver has applied to the points.
    """

    kind: str = "mid360"
    topic: str = "rt/livox/lidar"
    host: str = "192.168.1.50"
    point_port: int = HOST_POINT_PORT
    extrinsic: Extrinsic = field(default_factory=Extrinsic)


KINDS = ("mid360", "packets", "PointCloud2", "CustomMsg")


POINTS_PER_SECOND = 200_000
"""Of a Mid-360, hits and misses."""


class Frames:
    """Frames of a sensor, cut to the policy's period.

    Attributes:
        number: of frames so far.
        came: of those that hold a point.
        received: points that the newest call of `new` has read, message by message, in the sensor's own frame.
    """

    def __init__(self, source: LidarSource, lidar: Lidar, network: Network) -> None:
        """Args: source: of the points; lidar: that the policy was trained with; network: of a topic."""
        if source.kind not in KINDS:
            raise DeployError(f"points={source.kind}: one of {', '.join(KINDS)} was expected")
        is_topic = source.kind in ("PointCloud2", "CustomMsg")
        measured = round(POINTS_PER_SECOND * lidar.period_s)
        if not is_topic and lidar.points_per_frame != measured:
            raise DeployError(
                f"points={source.kind}: a Mid-360 measures {measured} points in {lidar.period_s:g} s, the policy was"
                f" trained with a LiDAR of {lidar.points_per_frame}; train with lidar=mid360, or give its own points="
            )
        self._source: _Topic | _Packets = _Topic(source, network) if is_topic else _Packets(source)
        self._cutter, self._extrinsic = FrameCutter(lidar.period_s), source.extrinsic
        self.received: list[Points] = []
        self.number = self.came = 0
        self._of_all, self._told = Counter(messages=0, points=0, misses=0), Counter[str]()

    def new(self) -> list[Frame]:
        """Frames that have become complete since the call before, oldest first, in the sensor's own frame."""
        self.received, now = self._in_the_sensor(self._source.read()), time.monotonic()
        frames = [frame for points in self.received for frame in self._cutter.add(points, now)]
        self.number += len(frames)
        if seen := sum(bool(frame.points.any()) for frame in frames):
            self.came, self._told = self.came + seen, self._all()
        return frames

    def _in_the_sensor(self, given: list[Points]) -> list[Points]:
        """Messages with points in the sensor's own frame; turned together, as a step reads some forty packets."""
        if not given:
            return []
        own = self._extrinsic.undo(np.concatenate([message.points for message in given]))
        hits = int(own.any(axis=1).sum())
        self._of_all.update(messages=len(given), points=hits, misses=len(own) - hits)
        ends = np.cumsum([len(message.points) for message in given])
        return [Points(part, m.times_ns) for part, m in zip(np.split(own, ends[:-1]), given, strict=True)]

    def counts(self) -> dict[str, int]:
        """What has come, and what went wrong, so far, by name."""
        came = {f"LiDAR {what}": count for what, count in self._of_all.items()}
        return came | self._source.counts() | self._cutter.counts()

    def _all(self) -> Counter[str]:
        return Counter(self.counts()) + Counter(frames=self.number)

    def why_silent(self) -> str:
        """What has come since the newest frame with points, or the call before."""
        now = self._all()
        new, self._told = now - self._told, now
        came = ", ".join(f"{count} {what}" for what, count in new.items()) or "nothing"
        if new["LiDAR points"]:
            return f"{came} came"
        return f"{came} came; {'every point is a miss' if new['LiDAR messages'] else self._source.why_silent()}"

    def close(self) -> None:
        """Ends it."""
        self._source.close()


class _Packets:
    """The Mid-360's own packets."""

    def __init__(self, source: LidarSource) -> None:
        self._mid360 = Mid360(source.host, source.point_port)
        if source.kind == "mid360":
            self._mid360.find()

    def read(self) -> list[Points]:
        """Those that have come since the call before, message by message."""
        return [Points(without_noise(p.points, p.tags), p.times_ns) for p in self._mid360.packets()]

    def counts(self) -> dict[str, int]:
        """What went wrong, by name."""
        mid360 = self._mid360
        return {"packets lost": mid360.lost, "packets doubled": mid360.doubled, **mid360.others}

    def why_silent(self) -> str:
        """What is known of why no points have come since the call before."""
        sensor, here = self._mid360.sensor, f"{self._mid360.host}:{self._mid360.point_port}"
        if sensor is None:
            return f"a Mid-360 that samples was expected to send points to {here}; points=mid360 tells it to"
        return f"the {sensor} at {sensor.address} was told to send points to {here}"

    def close(self) -> None:
        self._mid360.close()


class _Topic:
    """A driver's messages."""

    def __init__(self, source: LidarSource, network: Network) -> None:
        custom = source.kind == "CustomMsg"
        self._reader: Reader = network.reader(source.topic, CUSTOM_MSG if custom else POINT_CLOUD2, 16)
        self._decode = read_custom_msg if custom else read_point_cloud2
        self._other = "PointCloud2" if custom else "CustomMsg"
        self._refused, self._why = 0, ""

    def read(self) -> list[Points]:
        read = []
        for data in self._reader.take():
            try:
                read.append(in_one_time(self._decode(data)))
            except DeployError as error:
                self._refused, self._why = self._refused + 1, str(error)
                if self._refused == 1:  # the robot stands without frames; this is why
                    say(f"refused: {error}")
        return read

    def counts(self) -> dict[str, int]:
        return {"messages refused": self._refused}

    def why_silent(self) -> str:
        if self._why:
            why, self._why = f"the newest was refused: {self._why}", ""
            return why
        why = self._reader.why_silent()
        return f"{why}; points={self._other} reads it" if f"::{self._other}_" in why else why

    def close(self) -> None:
        """The network ends it."""
