"""MCAP files, record by record, so that one that is cut off is read up to the cut (mcap.dev/spec)."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader

from .message import Channel, Message, as_in_ros_2, unpacked

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEAD = struct.Struct("<HIQQ")
_DAMAGE = (McapError, struct.error, KeyError, ValueError)


def index(path: Path) -> Counter[Channel] | None:
    """How many messages each channel has, as the summary says; None without one."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("is not a readable MCAP file: it does not begin as one")
        try:
            summary = make_reader(file).get_summary()
        except (*_DAMAGE, OSError):
            return None
    counts = Counter[Channel]()
    if summary is not None and summary.statistics is not None:
        for number, count in summary.statistics.channel_message_counts.items():
            counts[_channel(summary.channels[number], summary.schemas)] += count
    return counts or None


def _channel(channel: records.Channel, schemas: dict[int, records.Schema]) -> Channel:
    schema = schemas.get(channel.schema_id) or records.Schema(0, b"", "", "")
    definition = schema.data.decode() if schema.encoding in ("ros1msg", "ros2msg") else ""
    return Channel(channel.topic, as_in_ros_2(schema.name), channel.message_encoding, definition)


def messages(path: Path, faults: list[str]) -> Iterator[Message]:
    """Messages in the order of the file; of a chunk that is cut off, those before the cut."""
    schemas, channels = dict[int, records.Schema](), dict[int, Channel]()
    damaged, ended = 0, False
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        for kind, content, whole in _opened(file):
            try:
                if kind == Opcode.MESSAGE and whole:
                    number, _, time_ns, _ = MESSAGE_HEAD.unpack_from(content)
                    yield Message(channels[number], time_ns, content[MESSAGE_HEAD.size :])
                elif kind == Opcode.SCHEMA and whole:
                    schema = records.Schema.read(ReadDataStream(BytesIO(content)))
                    schemas[schema.id] = schema
                elif kind == Opcode.CHANNEL and whole:
                    channel = records.Channel.read(ReadDataStream(BytesIO(content)))
                    channels[channel.id] = _channel(channel, schemas)
            except _DAMAGE:
                damaged += 1
            damaged += kind == Opcode.CHUNK
            if kind == Opcode.FOOTER and whole:
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
        part = _chunk(content, whole) if kind == Opcode.CHUNK else None
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
        chunk = records.Chunk.read(ReadDataStream(BytesIO(content)))
    except _DAMAGE:
        return None if whole else b""
    part = unpacked(chunk.data, chunk.compression)
    is_damaged = part is None or (whole and chunk.uncompressed_crc and zlib.crc32(part) != chunk.uncompressed_crc)
    return None if is_damaged else part
