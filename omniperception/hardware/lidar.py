"""Where frames come from on a robot: the Mid-360 itself, or a driver's topic."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from omniperception.deploy.description import DeployError, Lidar
from omniperception.hardware.clouds import (
    Extrinsic,
    Frame,
    FrameCutter,
    Points,
    read_custom_msg,
    read_point_cloud2,
    without_noise,
)
from omniperception.hardware.dds import CUSTOM_MSG, POINT_CLOUD2, Network, Reader
from omniperception.hardware.livox import HOST_POINT_PORT, Mid360


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


class Source(Protocol):
    """Points of a sensor."""

    def read(self) -> list[Points]:
        """Those that have come since the call before, message by message."""

    def counts(self) -> dict[str, int]:
        """What went wrong, by name."""

    def close(self) -> None:
        """Ends it."""


POINTS_PER_SECOND = 200_000
"""Of a Mid-360, hits and misses."""


class Frames:
    """Frames of a sensor, cut to the policy's period.

    Attributes:
        number: of frames so far.
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
        self._source: Source = _Topic(source, network) if is_topic else _Packets(source)
        self._cutter, self._extrinsic = FrameCutter(lidar.period_s), source.extrinsic
        self.received: list[Points] = []
        self.number = 0

    def new(self) -> list[Frame]:
        """Frames that have become complete since the call before, oldest first, in the sensor's own frame."""
        self.received = self._in_the_sensor(self._source.read())
        frames = [frame for points in self.received for frame in self._cutter.add(points)]
        self.number += len(frames)
        return frames

    def _in_the_sensor(self, given: list[Points]) -> list[Points]:
        """Messages with points in the sensor's own frame; turned together, as a step reads some forty packets."""
        if not given:
            return []
        own = self._extrinsic.undo(np.concatenate([message.points for message in given]))
        ends = np.cumsum([len(message.points) for message in given])
        return [Points(part, m.times_ns) for part, m in zip(np.split(own, ends[:-1]), given, strict=True)]

    def counts(self) -> dict[str, int]:
        """What went wrong so far, by name."""
        return self._source.counts() | {"late points": self._cutter.late, "jumps of time": self._cutter.jumps}

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
        return [Points(without_noise(p.points, p.tags), p.times_ns) for p in self._mid360.packets()]

    def counts(self) -> dict[str, int]:
        mid360 = self._mid360
        return {"packets lost": mid360.lost, "packets doubled": mid360.doubled, "other datagrams": mid360.other}

    def close(self) -> None:
        self._mid360.close()


def _in_one_time(message: Points) -> Points:
    """The message, whose points were measured within a second of each other; a DeployError otherwise."""
    span_s = 1e-9 * float(np.ptp(message.times_ns)) if len(message.times_ns) else 0.0
    if span_s > 1.0:
        raise DeployError(f"a message's points span {span_s:.3g} s, at most 1 s was expected; see the driver's times")
    return message


class _Topic:
    """A driver's messages."""

    def __init__(self, source: LidarSource, network: Network) -> None:
        custom = source.kind == "CustomMsg"
        self._reader: Reader = network.reader(source.topic, CUSTOM_MSG if custom else POINT_CLOUD2, 16)
        self._decode = read_custom_msg if custom else read_point_cloud2
        self._refused = 0

    def read(self) -> list[Points]:
        read = []
        for data in self._reader.take():
            try:
                read.append(_in_one_time(self._decode(data)))
            except DeployError as error:
                self._refused += 1
                if self._refused == 1:  # the robot stands without frames; this is why
                    print(f"refused: {error}", file=sys.stderr, flush=True)
        return read

    def counts(self) -> dict[str, int]:
        return {"messages refused": self._refused}

    def close(self) -> None:
        """The network ends it."""
