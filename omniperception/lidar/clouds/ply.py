"""Point clouds as .ply files: the element "vertex", as text or binary; written binary, little endian."""

from pathlib import Path

import numpy as np

from .table import PointTable

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
NAMES = {np.dtype(kind): name for name, kind in reversed(TYPES.items())}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
FRAME, TIME = "frame", "time_s"
"""First words of the comments that name the frame and the time."""


def read(path: Path) -> PointTable:
    """The vertices of a file, the first of its elements."""
    content = path.read_bytes()
    head, mark, body = content.partition(b"end_header")
    texts = head.decode("utf-8", "replace").splitlines()
    lines = [text.split() for text in texts]
    if not mark or lines[:1] != [["ply"]]:
        raise ValueError(f"{path} is not a PLY file: it does not begin with 'ply' and 'end_header'")
    order = next((line[1] for line in lines if line[:1] == ["format"]), "")
    elements = [k for k, line in enumerate(lines) if line[:1] == ["element"]]
    if order not in ORDERS or not elements or lines[elements[0]][1] != "vertex":
        raise ValueError(f"{path}: PLY format {order!r} must be one of {', '.join(ORDERS)}, and vertices come first")
    end = elements[1] if len(elements) > 1 else len(lines)
    properties = [line for line in lines[elements[0] : end] if line[:1] == ["property"]]
    unknown = [" ".join(line) for line in properties if line[1] not in TYPES]
    if unknown:
        raise ValueError(f"{path}: a vertex has {unknown[0]!r}, expected a number")
    if not properties:
        raise ValueError(f"{path}: a vertex has no properties")
    dtype = np.dtype([(line[2], ORDERS[order] + TYPES[line[1]]) for line in properties])
    count = int(lines[elements[0]][2])
    body = body.partition(b"\n")[2]
    if order == "ascii":
        rows = [tuple(line.split()) for line in body.decode("ascii").splitlines()[:count]]
        points = np.array(rows, dtype=dtype)
    else:
        points = np.frombuffer(body, dtype, min(count, len(body) // dtype.itemsize))
    if len(points) < count:
        raise ValueError(f"{path} ends after {len(points)} of {count} points")
    comments = [text.removeprefix("comment ").partition(" ") for text in texts if text.startswith("comment ")]
    said = {word: rest for word, _, rest in comments if rest}
    try:
        time_s = float(said.get(TIME, 0.0))
    except ValueError:
        raise ValueError(f"{path}: its comment says {TIME} {said[TIME]}, a number of seconds was expected") from None
    return PointTable(points, said.get(FRAME, ""), time_s)


def write(path: Path, table: PointTable) -> None:
    """Writes one vertex for each point."""
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
