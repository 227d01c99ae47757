"""Point clouds as .pcd files, of the Point Cloud Library; written binary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .table import PADDING, PointTable, check_words, column_names, held, numbers, rows_of_text, table_of

STANDARDS = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}
"""What a line that is left out would say of each field."""
KINDS = {"F": "f", "I": "i", "U": "u"}
FIRST_LINE = "# .PCD v0.7 - Point Cloud Data file format"
"""Of every file; what follows in ours is the frame and the time, a comment to other programs."""


@dataclass(frozen=True)
class _Field:
    """Numbers of a kind, so many for each point."""

    name: str
    kind: np.dtype
    count: int

    @property
    def size(self) -> int:
        """Bytes for each point."""
        return self.kind.itemsize * self.count

    @property
    def is_padding(self) -> bool:
        """Whether it is no field, but bytes between others."""
        return self.name in PADDING or not self.count

    def columns(self) -> list[str]:
        """A name for each number."""
        return [self.name] * self.count if self.is_padding else column_names(self.name, self.count)

    def of(self, rows: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Columns of its bytes, (P, size)."""
        if self.is_padding:
            return []
        return list(zip(self.columns(), np.ascontiguousarray(rows).view(self.kind).T, strict=True))


def read(path: Path) -> PointTable:
    """The points of a file: text, binary or compressed.

    Padding, fields named ``_``, is left out; a field of several numbers becomes columns ``name__0000``, ... A file that
    is cut off is read up to there, and one line on standard error says so.
    """
    content = path.read_bytes()
    header, at = _header(path, content)
    fields = _fields(path, header)
    width, height, points = (
        _whole(path, header, key, standard) for key, standard in (("WIDTH", 0), ("HEIGHT", 1), ("POINTS", 0))
    )
    told, body, how = max(width * height, points), content[at:], " ".join(header["DATA"]).lower()
    if how == "ascii":
        columns = _of_text(path, body, fields, told)
    elif how == "binary":
        columns = _of_rows(path, body, fields, told)
    elif how == "binary_compressed":
        columns = _of_blocks(path, body, fields, told)
    else:
        raise ValueError(f"{path}: DATA is {how!r}, ascii, binary or binary_compressed was expected")
    return table_of(columns, *_said(content.partition(b"\n")[0].decode("utf-8", "replace").rstrip("\r")))


def _header(path: Path, content: bytes) -> tuple[Mapping[str, list[str]], int]:
    """Words of each line by its first, and where the points begin."""
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        line, end, _ = content[at : at + 65536].partition(b"\n")
        if not line and not end:
            raise ValueError(f"{path} is not a PCD file: lines up to DATA were expected")
        at += len(line) + len(end)
        key, *words = line.decode("utf-8", "replace").split() or ["#"]
        if not key.startswith("#"):
            header["FIELDS" if key.upper() == "COLUMNS" else key.upper()] = words  # COLUMNS is version .5's
    return header, at


def _fields(path: Path, header: Mapping[str, list[str]]) -> list[_Field]:
    """What each point has."""
    names = header.get("FIELDS", [])
    about = {key: header.get(key) or [standard] * len(names) for key, standard in STANDARDS.items()}
    for key, words in about.items():
        if len(words) != len(names):
            raise ValueError(f"{path}: {key} has {len(words)} values, and there are {len(names)} FIELDS")
    fields = []
    for name, size, kind, count in zip(names, *about.values(), strict=True):
        try:
            if int(count) < 0:
                raise ValueError
            fields.append(_Field(name, np.dtype(f"<{KINDS[kind]}{size}"), int(count)))
        except (KeyError, TypeError, ValueError):
            raise ValueError(
                f"{path}: field {name} has TYPE {kind}, SIZE {size}, COUNT {count}; no such numbers"
            ) from None
    kept = [field.name for field in fields if not field.is_padding]
    if not kept or len(set(kept)) < len(kept):
        raise ValueError(f"{path}: FIELDS {' '.join(names)} names nothing, or one thing twice")
    return fields


def _whole(path: Path, header: Mapping[str, list[str]], key: str, standard: int) -> int:
    given = " ".join(header.get(key, [str(standard)]))
    if not given.isdecimal():
        raise ValueError(f"{path}: {key} is {given}, a whole number was expected")
    return int(given)


def _of_text(path: Path, body: bytes, fields: list[_Field], told: int) -> dict[str, np.ndarray]:
    columns = [(name, field.kind) for field in fields for name in field.columns()]
    return numbers(path, rows_of_text(path, body, len(columns), told), columns)


def _of_rows(path: Path, body: bytes, fields: list[_Field], told: int) -> dict[str, np.ndarray]:
    """Point after point."""
    step = sum(field.size for field in fields)
    count = held(path, len(body) // step, told)
    rows = np.frombuffer(body, np.uint8, count * step).reshape(count, step)
    starts = np.cumsum([0, *(field.size for field in fields)])
    return {
        name: column
        for start, field in zip(starts, fields, strict=False)
        for name, column in field.of(rows[:, start : start + field.size])
    }


def _of_blocks(path: Path, body: bytes, fields: list[_Field], told: int) -> dict[str, np.ndarray]:
    """Field after field, packed by LibLZF; of a file that is cut off, points and fields before the cut."""
    packed, size = np.frombuffer(body[:8].ljust(8, b"\0"), "<u4").tolist()
    for stored in ([field for field in fields if not field.is_padding], fields):  # PCL leaves padding out
        if size == told * sum(field.size for field in stored):
            break
    else:
        raise ValueError(f"{path}: it says {size} bytes unpacked, and {told} points of its fields have another size")
    content, start = np.frombuffer(_unpacked(body[8 : 8 + packed], size), np.uint8), 0
    there: list[tuple[_Field, np.ndarray]] = []
    for field in (field for field in stored if field.count):
        whole = content[start : start + told * field.size]
        there.append((field, whole[: len(whole) // field.size * field.size].reshape(-1, field.size)))
        start += told * field.size
    count = min((len(part) for field, part in there if field.name in ("x", "y", "z")), default=told)
    lost = [field.name for field, part in there if len(part) < count and not field.is_padding]
    count = held(path, count, told, lost)
    kept = [(field, part[:count]) for field, part in there if len(part) >= count]
    return {name: column for field, part in kept for name, column in field.of(part)}


def _unpacked(packed: bytes, size: int) -> bytes:
    """Of LibLZF, as far as it goes: bytes as they are, or a length and how far back to copy from."""
    out, at, end = bytearray(), 0, len(packed)
    while at < end and len(out) < size:
        head = packed[at]
        if head < 32:
            out += packed[at + 1 : at + head + 2]
            at += head + 2
            continue
        long = head >> 5 == 7
        if at + 1 + long >= end:
            break
        length = (head >> 5) + 2 + (packed[at + 1] if long else 0)
        back = ((head & 31) << 8) + packed[at + 1 + long] + 1
        part = out[-back:][:length]
        out += (part * (length // back + 1))[:length]
        at += 2 + long
    return bytes(out[:size])


def write(path: Path, table: PointTable) -> None:
    """Writes a binary file."""
    from pypcd4 import Encoding, PointCloud

    check_words(path, table.names)
    types = [table.points.dtype[name] for name in table.names]
    for name, dtype in zip(table.names, types, strict=True):
        if dtype.kind not in "fiu" or (dtype.kind == "f" and dtype.itemsize < 4):
            raise ValueError(f"{path}: PCD has no type for column {name} of {dtype}; use whole numbers or float32")
    cloud = PointCloud.from_points([table.points[name] for name in table.names], table.names, types)
    cloud.save(path, encoding=Encoding.BINARY)
    _, _, rest = path.read_bytes().partition(b"\n")
    said = f"{FIRST_LINE} {table.frame or '-'} {table.time_s!r}\n"
    path.write_bytes(said.encode() + rest)


def _said(first: str) -> tuple[str, float] | tuple[()]:
    """Frame and time of a first line that `write` wrote."""
    frame, _, time_s = first.removeprefix(f"{FIRST_LINE} ").rpartition(" ")
    try:
        return ("" if frame == "-" else frame, float(time_s)) if first.startswith(f"{FIRST_LINE} ") and frame else ()
    except ValueError:
        return ()
