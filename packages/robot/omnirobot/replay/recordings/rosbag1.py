"""Bags of ROS 1, record by record, so that one that is cut off is read up to the cut (wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

from rosbags.rosbag1 import Reader, ReaderError

from .message import Channel, Message, as_in_ros_2, unpacked

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, CONNECTION = b"\x02", b"\x05", b"\x07"

Fields = dict[bytes, bytes]


def index(path: Path) -> Counter[Channel] | None:
    """How many messages each topic has, as the end of the file says; None where that is missing."""
    with path.open("rb") as file:
        first = file.readline(80)
    if first != MAGIC:
        older = first.startswith(b"#ROSBAG V")
        raise ValueError(
            "is not a readable bag: it is older than version 2.0 (rosbag migrate)"
            if older
            else "is not a readable bag of ROS 1: it does not begin as one"
        )
    counts = Counter[Channel]()
    try:
        with Reader(path) as bag:
            for connection in bag.connections:
                counts[Channel(connection.topic, as_in_ros_2(connection.msgtype), "ros1")] += connection.msgcount
    except (ReaderError, ValueError):
        return None
    return counts or None


def messages(path: Path, faults: list[str]) -> Iterator[Message]:
    """Messages in the order of the file; of a chunk that is cut off, those before the cut."""
    channels, damaged = dict[bytes, Channel](), 0
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        index_at = _index_at(file)
        for fields, content, whole in _opened(file):
            kind = fields.get(b"op")
            try:
                if kind == MESSAGE and whole:
                    seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                    yield Message(channels[fields[b"conn"]], seconds * 10**9 + nanoseconds, content)
                elif kind == CONNECTION and whole:
                    about = _fields(content)
                    name, definition = about[b"type"].decode(), about[b"message_definition"].decode("utf-8", "replace")
                    channels[fields[b"conn"]] = Channel(
                        fields[b"topic"].decode(), as_in_ros_2(name), "ros1", definition
                    )
            except (struct.error, KeyError, UnicodeDecodeError):
                damaged += 1
            damaged += kind == CHUNK
        end = file.tell()
    if not index_at:
        faults.append("has no index, as a killed recorder leaves it (rosbag reindex writes one)")
    elif end <= index_at:
        faults.append(f"is cut off after {end} bytes")
    if damaged:
        faults.append(f"has {damaged} damaged records, which are left out")


def _opened(file: IO[bytes]) -> Iterator[tuple[Fields, bytes, bool]]:
    """As ``_records``, with those in chunks; a chunk that is damaged remains."""
    for fields, content, whole in _records(file):
        part = None
        if fields.get(b"op") == CHUNK:  # one whose length was to be written when it was full goes on to the end
            how = fields.get(b"compression", b"").decode("utf-8", "replace")
            part = unpacked(content or file.read(), how)
        if part is None:
            yield fields, content, whole
        else:
            yield from _records(BytesIO(part))


def _index_at(file: IO[bytes]) -> int:
    """Where the first record says that the index begins; 0: nowhere."""
    fields, _, _ = next(_records(file), ({}, b"", False))
    return int.from_bytes(fields.get(b"index_pos", b""), "little")


def _records(file: IO[bytes]) -> Iterator[tuple[Fields, bytes, bool]]:
    """Fields and content of each record, and whether it is whole."""
    start = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(start)
    while len(head := file.read(4)) == 4 and any(head):
        fields = _fields(file.read(min(int.from_bytes(head, "little"), end - file.tell())))
        length = file.read(4)
        size = int.from_bytes(length, "little")
        content = file.read(min(size, end - file.tell()))
        yield fields, content, len(length) == 4 and len(content) == size


def _fields(content: bytes) -> Fields:
    """Values by name, each pair with its length before it."""
    fields, at = {}, 0
    while at < len(content):
        end = at + 4 + int.from_bytes(content[at : at + 4], "little")
        name, _, value = content[at + 4 : end].partition(b"=")
        fields[name], at = value, end
    return fields
