"""Point clouds as .ply files: binary, with a colour and any further numbers for each point."""

from __future__ import annotations

from pathlib import Path

import numpy as np

TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}


def write_ply(path: Path, points: np.ndarray, rgb: np.ndarray, **fields: np.ndarray) -> None:
    """Writes points with colours.

    Args:
        path: Where to.
        points: Metres, (P, 3).
        rgb: 0 to 255, (P, 3).
        fields: Further properties of the points by name, (P,) each, stored as float or, where whole, as int.
    """
    columns = [(name, "<f4", points[:, k]) for k, name in enumerate("xyz")]
    columns += [(name, "|u1", rgb[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    for name, values in fields.items():
        columns.append((name, "<i4" if np.issubdtype(values.dtype, np.integer) else "<f4", values))
    table = np.empty(len(points), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {TYPES[kind]} {name}" for name, kind, _ in columns]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + table.tobytes())
