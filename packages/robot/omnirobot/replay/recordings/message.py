"""A message of a recording, and how it is decoded."""

from __future__ import annotations

import bz2
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

from omnirobot.common.ros import ros_types

ZSTD = b"\x28\xb5\x2f\xfd"
"""Begins what zstd has packed, such as each message of a bag in the mode "message"."""


@dataclass(frozen=True)
class Channel:
    """What messages of a topic are.

    Attributes:
        topic: its name.
        kind: type, named as in ROS 2: sensor_msgs/msg/Imu.
        encoding: of messages; "cdr" or "ros1".
        definition: of the type, where the file gives it as ROS does.
    """

    topic: str
    kind: str
    encoding: str = "cdr"
    definition: str = ""


@dataclass(frozen=True)
class Message:
    """One of a recording.

    Attributes:
        channel: its topic and type.
        time_ns: when it was recorded.
        raw: as it is in the file.
    """

    channel: Channel
    time_ns: int
    raw: bytes

    @property
    def topic(self) -> str:
        """Of the channel."""
        return self.channel.topic

    @property
    def kind(self) -> str:
        """Of the channel."""
        return self.channel.kind

    @property
    def data(self) -> bytes:
        """CDR.

        Raises:
            ValueError: It is damaged.
        """
        if self.channel.encoding == "ros1":
            with self._parsing():
                return bytes(_types(self.channel).ros1_to_cdr(self.raw, self.kind))
        return (unpacked(self.raw, "zstd") or b"") if self.raw.startswith(ZSTD) else self.raw

    def decode(self) -> Any:
        """An object with the type's fields.

        Raises:
            ValueError: It is damaged.
        """
        data = self.data
        with self._parsing():
            return _types(self.channel).deserialize_cdr(data, self.kind)

    @contextmanager
    def _parsing(self) -> Iterator[None]:
        try:
            yield
        except ModuleNotFoundError:
            raise
        except Exception as error:  # rosbags raises errors of many kinds
            raise ValueError(f"{self.topic}: a message is damaged, or no {self.kind}") from error


def as_in_ros_2(kind: str) -> str:
    """sensor_msgs/msg/Imu of sensor_msgs/Imu."""
    return kind.replace("/", "/msg/") if kind.count("/") == 1 else kind


def unpacked(data: bytes, how: str) -> bytes | None:
    """A part of a file that is packed by "lz4", "zstd", "bz2" or not at all, as far as it goes; None: it is damaged."""
    if how in ("", "none"):
        return data
    import zstandard
    from lz4.frame import LZ4FrameDecompressor

    made = {"zstd": zstandard.ZstdDecompressor().decompressobj, "lz4": LZ4FrameDecompressor, "bz2": bz2.BZ2Decompressor}
    try:
        return made[how]().decompress(data)
    except (KeyError, zstandard.ZstdError, RuntimeError, OSError):  # RuntimeError is lz4's, OSError bz2's
        return None


@cache
def _types(channel: Channel) -> Any:
    """ROS's own types and, where it is none of these, that of a channel."""
    from rosbags.typesys import get_types_from_msg

    if channel.kind in ros_types().types or not channel.definition:
        return ros_types()
    given = get_types_from_msg(channel.definition, channel.kind)
    store = ros_types.__wrapped__()  # a new one, as another file may mean something else by this name
    store.register({kind: fields for kind, fields in given.items() if kind not in store.types})
    return store
