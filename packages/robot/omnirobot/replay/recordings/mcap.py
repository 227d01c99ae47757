"""MCAP files, from their first record to their last: no index is needed (mcap.dev/spec)."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

from .message import Channel, Message, as_in_ros_2, unpacked

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B
FOOTER_BYTES = 9 + 20 + len(MAGIC)
"""Of the last record and of what ends a file."""
COUNTS_AT = 46
"""In the record of statistics."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
DEFINITIONS = {"cdr": "ros2msg", "ros1": "ros1msg"}
"""How definitions are written that go with an encoding of messages and are understood."""


class _Channels:
    """Schemas and channels that a file has named so far."""

    def __init__(self) -> None:
        self.by_id: dict[int, Channel] = {}
        self._schemas: dict[int, tuple[str, str, str]] = {0: ("", "", "")}

    def take(self, kind: int, content: bytes) -> Message | None:
        """Takes down a record; the message where it is one.

        Raises:
            struct.error, KeyError, UnicodeDecodeError: It is damaged.
        """
        if kind == MESSAGE:
            number, _, time_ns, _ = MESSAGE_HEAD.unpack_from(content)
            return Message(self.by_id[number], time_ns, content[MESSAGE_HEAD.size :])
        if kind == SCHEMA:
            name, encoding, definition = _texts(content, 2, 3)
            self._schemas[_uint16(content, 0)] = name, encoding, definition
        elif kind == CHANNEL:
            topic, encoding = _texts(content, 4, 2)
            name, written, definition = self._schemas[_uint16(content, 2)]
            known = written == DEFINITIONS.get(encoding)
            self.by_id[_uint16(content, 0)] = Channel(topic, as_in_ros_2(name), encoding, definition if known else "")
        return None


def index(path: Path) -> Counter[Channel] | None:
    """How many messages each channel has, as the summary says; None without one."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("is not a readable MCAP file: it does not begin as one")
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - FOOTER_BYTES, 0))
        end = file.read()
        start = int.from_bytes(end[9:17], "little")
        if end[0] != FOOTER or not end.endswith(MAGIC) or not 0 < start < size:
            return None
        file.seek(start)
        channels, counts = _Channels(), Counter[Channel]()
        try:
            for kind, content, _ in _records(file):
                channels.take(kind, content)
                if kind == STATISTICS:
                    for number, count in struct.iter_unpack("<HQ", content[COUNTS_AT:]):
                        counts[channels.by_id[number]] += count
        except (struct.error, KeyError, UnicodeDecodeError):
            return None
    return counts or None


def messages(path: Path, faults: list[str]) -> Iterator[Message]:
    """Messages in the order of the file; of a chunk that is cut off, those before the cut."""
    channels, damaged, ended = _Channels(), 0, False
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        for kind, content, whole in _opened(file):
            try:
                message = channels.take(kind, content) if whole else None
            except (struct.error, KeyError, UnicodeDecodeError):
                message, damaged = None, damaged + 1
            if message is not None:
                yield message
            elif kind == CHUNK:
                damaged += 1
            elif kind == FOOTER and whole:
                ended = True
                if not any(content[:8]):
                    faults.append("has no summary, the index that a recorder writes when it ends")
        if not ended:
            faults.append(f"is cut off after {file.tell()} bytes, as a killed recorder leaves it")
    if damaged:
        faults.append(f"has {damaged} damaged records, which are left out")


def _opened(file: IO[bytes]) -> Iterator[tuple[int, bytes, bool]]:
    """As ``_records``, with those in chunks; a chunk that is damaged remains."""
    for kind, content, whole in _records(file):
        part = _chunk(content, whole) if kind == CHUNK else None
        if part is None:
            yield kind, content, whole
        else:
            yield from _records(BytesIO(part))


def _records(file: IO[bytes]) -> Iterator[tuple[int, bytes, bool]]:
    """Kind and content of each record, and whether it is whole."""
    start = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(start)
    while len(head := file.read(9)) == 9 and head[0]:
        length = int.from_bytes(head[1:], "little")
        content = file.read(min(length, end - file.tell()))
        yield head[0], content, len(content) == length


def _chunk(content: bytes, whole: bool) -> bytes | None:
    """The records in a chunk, or as much of them as is there; None: they are damaged."""
    try:
        checksum, name_length = struct.unpack_from("<II", content, 24)
        (how,) = _texts(content, 28, 1)
    except (struct.error, UnicodeDecodeError):
        return None if whole else b""
    part = unpacked(content[40 + name_length :], how)
    return None if part is None or (whole and checksum and zlib.crc32(part) != checksum) else part


def _uint16(content: bytes, at: int) -> int:
    return int.from_bytes(content[at : at + 2], "little")


def _texts(content: bytes, at: int, count: int) -> list[str]:
    """So many texts after each other, each with its length before it."""
    texts = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", content, at)
        texts.append(content[at + 4 : at + 4 + length].decode())
        at += 4 + length
    return texts
