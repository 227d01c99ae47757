"""Files of ROS 2's bags in SQLite; of one that is cut off, the rows that are whole (sqlite.org/fileformat)."""

from __future__ import annotations

import mmap
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from .message import Channel, Message

MAGIC = b"SQLite format 3\0"
TOPICS = "SELECT id, name, type, serialization_format FROM topics"
COUNTS = "SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"
MESSAGES = "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
LEAF = 0x0D
"""First byte of a page with rows of a table."""
INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
"""Bytes of a whole number by its type in a row; 8 and 9 are the numbers 0 and 1."""


def index(path: Path) -> Counter[Channel] | None:
    """How many messages each topic has; None where the file is broken."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("is not a readable bag of ROS 2: an SQLite file was expected")
    try:
        with closing(_opened(path)) as base:
            channels = _channels(base)
            return Counter({channels[number]: count for number, count in base.execute(COUNTS) if number in channels})
    except sqlite3.DatabaseError as error:
        if "no such table" in str(error):
            raise ValueError("is not a readable bag of ROS 2: it has no tables topics and messages") from None
        return None


def messages(path: Path, faults: list[str]) -> Iterator[Message]:
    """Messages in the order in which they were written."""
    last = -1
    try:
        with closing(_opened(path)) as base:
            channels = _channels(base)
            for number, topic, time_ns, data in base.execute(MESSAGES):
                last = number
                if topic in channels:
                    yield Message(channels[topic], time_ns, data)
    except sqlite3.DatabaseError:
        faults.append("is cut off or damaged, as a killed recorder leaves it")
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            yield from _found(_Rows(content), last)


def _opened(path: Path) -> sqlite3.Connection:
    """Read only, with what a killed recorder left in a -wal file beside it."""
    beside = path.with_name(f"{path.name}-wal").exists()
    return sqlite3.connect(f"file:{quote(str(path.resolve()))}?{'mode=ro' if beside else 'immutable=1'}", uri=True)


def _channels(base: sqlite3.Connection) -> dict[int, Channel]:
    return {number: Channel(*about) for number, *about in base.execute(TOPICS)}


def _found(rows: _Rows, last: int) -> Iterator[Message]:
    """Messages behind a row, wherever in the file they are: the tree that leads to them is broken."""
    channels = {
        number: Channel(name, kind, encoding)
        for number, (_, name, kind, encoding, *_) in rows.like(type(None), str, str, str)
        if name.startswith("/")  # else it is a type's definition
    }
    for number, (_, topic, time_ns, data) in rows.like(type(None), int, int, bytes):
        if number > last and topic in channels:
            last = number
            yield Message(channels[topic], time_ns, data)


class _Rows:
    """Rows of all tables in the pages that are there, sorted by their numbers."""

    def __init__(self, content: mmap.mmap) -> None:
        self._content = content
        size = int.from_bytes(content[16:18], "big")
        self._page = 65536 if size == 1 else max(size, 512)
        self._usable = self._page - content[20]
        self._cells = sorted(cell for start in range(0, len(content), self._page) for cell in self._on_page(start))

    def like(self, *types: type) -> Iterator[tuple[int, list[Any]]]:
        """Numbers and values of the whole rows that begin with values of these types."""
        for number, start, size in self._cells:
            try:
                at, kinds = self._kinds(start)
            except IndexError:  # behind the cut
                continue
            if tuple(map(_type, kinds[: len(types)])) == types and len(row := self._payload(start, size)) == size:
                yield number, _values(row[at - start :], kinds)

    def _on_page(self, start: int) -> Iterator[tuple[int, int, int]]:
        """Number, place and size of each row."""
        head = start + 100 * (start == 0)
        if self._content[head : head + 1] != bytes([LEAF]):
            return
        for k in range(self._number(head + 3, 2)):
            try:
                size, at = self._varint(start + self._number(head + 8 + 2 * k, 2))
                number, at = self._varint(at)
            except IndexError:  # behind the cut
                continue
            yield number, at, size

    def _kinds(self, start: int) -> tuple[int, list[int]]:
        """Where a row's values begin, and the types of them."""
        length, at = self._varint(start)
        kinds = []
        while at < start + length:
            kind, at = self._varint(at)
            kinds.append(kind)
        return start + length, kinds

    def _payload(self, start: int, size: int) -> bytes:
        """A row of that many bytes, or what is there of it: what no page has room for is in a chain of others."""
        most, least = self._usable - 35, (self._usable - 12) * 32 // 255 - 23
        local = size if size <= most else least + (size - least) % (self._usable - 4)
        local = least if local > most else local
        parts, left, pointer = [self._content[start : start + local]], size - local, start + local
        while left > 0 and (page := self._number(pointer, 4)):
            pointer = (page - 1) * self._page
            parts.append(self._content[pointer + 4 : pointer + min(self._usable, 4 + left)])
            left -= self._usable - 4
        return b"".join(parts)

    def _number(self, at: int, size: int) -> int:
        return int.from_bytes(self._content[at : at + size], "big")

    def _varint(self, at: int) -> tuple[int, int]:
        """A number of up to nine bytes, and what follows it."""
        value = 0
        for k in range(8):
            byte = self._content[at + k]
            value = value << 7 | byte & 0x7F
            if byte < 0x80:
                return value, at + k + 1
        return value << 8 | self._content[at + 8], at + 9


def _type(kind: int) -> type | None:
    """Of a value in a row; None: another than bags have."""
    if kind in INTEGERS:
        return int
    return type(None) if kind == 0 else None if kind < 12 else (bytes, str)[kind % 2]


def _values(content: bytes, kinds: list[int]) -> Any:
    values: list[Any] = []
    for kind in kinds:
        size = INTEGERS[kind] if kind in INTEGERS else max(kind - 12, 0) // 2
        part, content = content[:size], content[size:]
        if kind in INTEGERS:
            values.append(kind - 8 if kind > 6 else int.from_bytes(part, "big", signed=True))
        else:
            values.append(None if kind == 0 else part if kind % 2 == 0 else part.decode("utf-8", "replace"))
    return values
