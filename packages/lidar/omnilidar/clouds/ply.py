"""Point clouds as .ply files: the element "vertex", as text or binary; written binary, little endian."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .table import PointTable, check_words, held, numbers, rows_of_text, table_of

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
NAMES = {np.dtype(kind): name for name, kind in reversed(TYPES.items())}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
FRAME, TIME = "frame", "time_s"
"""First words of the comments that name the frame and the time."""


@dataclass(frozen=True)
class _Property:
    """A number, or a list of them, with the type of its length."""

    name: str
    kind: np.dtype
    length: np.dtype | None = None


@dataclass(frozen=True)
class _Element:
    """So many of a thing, each with these properties."""

    name: str
    count: int
    properties: list[_Property]

    @property
    def numbers(self) -> list[tuple[str, np.dtype]]:
        """Properties that are no lists."""
        return [(given.name, given.kind) for given in self.properties if given.length is None]

    @property
    def lists(self) -> list[str]:
        """The others' names."""
        return [given.name for given in self.properties if given.length is not None]


def read(path: Path) -> PointTable:
    """The vertices of a file; lists that they have are left out.

    A file that is cut off is read up to there; one line on standard error says so, and what was left out.
    """
    order, elements, body, texts = read_header(path, path.read_bytes())
    number = next((k for k, element in enumerate(elements) if element.name == "vertex"), None)
    if number is None:
        raise ValueError(f"{path}: a PLY file with vertices was expected, it has {[e.name for e in elements]}")
    vertex, before = elements[number], elements[:number]
    names = [name for name, _ in vertex.numbers]
    if not names:
        there = f"lists alone ({', '.join(vertex.lists)})" if vertex.lists else "no properties"
        raise ValueError(f"{path}: a vertex has {there}, expected a number for each of x, y and z")
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: a vertex has a property twice: {', '.join(names)}")
    if vertex.lists:
        print(f"{path}: left out, as lists are no columns: {', '.join(vertex.lists)}", file=sys.stderr, flush=True)
    columns = _of_text(path, body, before, vertex) if order == "ascii" else _of_bytes(path, body, before, vertex)
    comments = [text.removeprefix("comment ").partition(" ") for text in texts if text.startswith("comment ")]
    said = {word: rest for word, _, rest in comments if rest}
    try:
        time_s = float(said.get(TIME, 0.0))
    except ValueError:
        raise ValueError(f"{path}: its comment says {TIME} {said[TIME]}, a number of seconds was expected") from None
    return table_of(columns, said.get(FRAME, ""), time_s)


def read_header(path: Path, content: bytes) -> tuple[str, list[_Element], bytes, list[str]]:
    """The format, one of `ORDERS`; the elements; what follows the header; and its lines."""
    head, mark, body = content.partition(b"end_header")
    texts = head.decode("utf-8", "replace").splitlines()
    lines = [text.split() for text in texts]
    if not mark or lines[:1] != [["ply"]]:
        raise ValueError(f"{path} is not a PLY file: it does not begin with 'ply' and 'end_header'")
    order = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    if order not in ORDERS:
        raise ValueError(f"{path}: PLY format {order!r} must be one of {', '.join(ORDERS)}")
    return order, _elements(path, lines, ORDERS[order]), body.partition(b"\n")[2], texts


def _elements(path: Path, lines: list[list[str]], order: str) -> list[_Element]:
    elements: list[_Element] = []
    for line in lines:
        try:
            match line:
                case ["element", name, count] if count.isdecimal():
                    elements.append(_Element(name, int(count), []))
                case ["property", "list", length, kind, name]:
                    made = _Property(name, np.dtype(order + TYPES[kind]), np.dtype(order + TYPES[length]))
                    elements[-1].properties.append(made)
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, np.dtype(order + TYPES[kind])))
                case ["element" | "property", *_]:
                    raise ValueError
        except (KeyError, IndexError, ValueError):
            raise ValueError(f"{path}: its header has {' '.join(line)!r}; known types: {', '.join(TYPES)}") from None
    return elements


def _of_text(path: Path, body: bytes, before: list[_Element], vertex: _Element) -> dict[str, np.ndarray]:
    lines = [line for line in body.splitlines(keepends=True) if line.strip()]
    lines = lines[sum(element.count for element in before) :][: vertex.count]
    if vertex.lists:
        lines = [_without_lists(line, vertex) for line in lines]
    rows = rows_of_text(path, b"".join(lines), len(vertex.numbers), vertex.count)
    return numbers(path, rows, vertex.numbers)


def _without_lists(line: bytes, vertex: _Element) -> bytes:
    words, kept = line.split(), []
    for given in vertex.properties:
        if given.length is None:
            kept += words[:1]
            words = words[1:]
        else:
            words = words[1 + int(words[0]) :] if words and words[0].isdigit() else []
    return b" ".join(kept) + line[len(line.rstrip()) :]


def _of_bytes(path: Path, body: bytes, before: list[_Element], vertex: _Element) -> dict[str, np.ndarray]:
    at = 0
    for element in before:
        _, at = _rows(body, at, element)
    rows, _ = _rows(body, at, vertex)
    dtype = np.dtype(vertex.numbers)
    points = np.frombuffer(rows, dtype, held(path, len(rows) // dtype.itemsize, vertex.count))
    return {name: points[name].astype(dtype[name].newbyteorder("=")) for name in dtype.names or ()}


def _rows(body: bytes, at: int, element: _Element) -> tuple[bytes, int]:
    """Numbers of an element, as many as are there, without its lists; and what follows it."""
    if not element.lists:
        end = at + element.count * sum(kind.itemsize for _, kind in element.numbers)
        return body[at:end], end
    parts: list[bytes] = []
    for _ in range(element.count):
        for given in element.properties:
            if given.length is None:
                parts.append(body[at : at + given.kind.itemsize])
                at += given.kind.itemsize
            else:
                length = np.frombuffer(
                    body[at : at + given.length.itemsize].ljust(given.length.itemsize, b"\0"), given.length
                )
                at += given.length.itemsize + int(length[0]) * given.kind.itemsize
    return b"".join(parts), at


def write(path: Path, table: PointTable) -> None:
    """Writes one vertex for each point."""
    check_words(path, table.names)
    dtype = np.dtype([(name, table.points.dtype[name].newbyteorder("<")) for name in table.names])
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {FRAME} {table.frame}"] if table.frame else []
    header += [f"comment {TIME} {table.time_s!r}", f"element vertex {len(table)}"]
    header += [f"property {_type_name(path, name, table.points.dtype[name])} {name}" for name in table.names]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + table.points.astype(dtype).tobytes())


def _type_name(path: Path, name: str, dtype: np.dtype) -> str:
    known = NAMES.get(dtype.newbyteorder("="))
    if known is None:
        raise ValueError(f"{path}: PLY has no type for column {name} of {dtype}; use 32-bit whole numbers or floats")
    return known
