"""Point clouds as .las files, of surveying programs; columns that LAS does not know are its "extra dimensions".

.laz is the same, packed, where lazrs is installed.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from .table import PointTable, column_names, held, table_of

SCALE = 1e-4
"""Metres to which coordinates are kept."""
FRAME_BYTES = 32
"""Of the header's system identifier, which holds the name of the frame."""
SUFFIX = "_value"
"""Added to a column whose name LAS gives to a number of another type."""


def read(path: Path) -> PointTable:
    """The points of a file, withheld ones with coordinates that are not a number.

    Columns of LAS's own that are zero throughout are left out. A ``gps_time`` that all points share is the frame's. A
    file that is cut off is read up to there, and one line on standard error says so.
    """
    file = _read(path)
    shown = np.where(np.asarray(file.withheld, bool), np.nan, 1.0)
    columns = {axis: np.asarray(file[axis], np.float64) * shown for axis in "xyz"}
    extra = set(file.point_format.extra_dimension_names)
    for name in (name for name in file.point_format.dimension_names if name not in ("X", "Y", "Z", "withheld")):
        values = np.asarray(file[name])
        if name in extra or values.any():
            rows = values.T if values.ndim > 1 else values[None]  # an extra dimension may have two or three numbers
            names = column_names(name.removesuffix(SUFFIX) if name in extra else name, len(rows))
            columns |= dict(zip(names, rows, strict=True))
    times = np.unique(file["gps_time"] if "gps_time" in file.point_format.dimension_names else np.zeros(1))
    if len(times) == 1 and "gps_time" + SUFFIX not in extra:
        columns.pop("gps_time", None)
    frame = file.header.system_identifier  # bytes where they are no ASCII
    frame = frame.rstrip("\0") if isinstance(frame, str) else ""
    return table_of(columns, frame if frame.isprintable() else "", float(times[0]) if len(times) == 1 else 0.0)


def _read(path: Path) -> Any:
    """As much of a file as is there."""
    import laspy

    try:
        reader = laspy.open(path, read_evlrs=False)
    except Exception as error:  # laspy raises whatever its parsing meets
        raise ValueError(f"{path} is not a LAS file, or ends within its header") from error
    with reader:
        header = reader.header
        there = (path.stat().st_size - header.offset_to_point_data) // header.point_format.size
        if header.are_points_compressed:
            _check_laz(path)
        elif not header.point_count and there > 0 and not header.number_of_evlrs:
            print(f"{path} says that it has no points, as a killed program leaves it: read {there}", file=sys.stderr)
            header.point_count = there
        else:
            header.point_count = held(path, max(there, 0), header.point_count)
        try:
            return laspy.LasData(header, reader.read_points(header.point_count))
        except Exception as error:
            raise ValueError(f"{path} is damaged or cut off: its points cannot be read") from error


def _check_laz(path: Path) -> None:
    """Names what packs and unpacks LAZ, where it is missing."""
    import laspy

    if not laspy.LazBackend.detect_available():
        raise ValueError(f"{path} is LAZ, which needs lazrs: pip install lazrs (or convert it to .las)")


def write(path: Path, table: PointTable) -> None:
    """Writes LAS 1.4, coordinates to ``SCALE``; packed where the name ends in .laz."""
    import laspy

    if path.suffix.lower() == ".laz":
        _check_laz(path)
    if not table.frame.isascii() or len(table.frame) > FRAME_BYTES:
        raise ValueError(f"{path}: LAS keeps a frame's name of at most {FRAME_BYTES} ASCII characters: {table.frame!r}")
    header = laspy.LasHeader(version="1.4", point_format=6)
    xyz = table.xyz
    missed = ~np.isfinite(xyz).all(axis=1)
    seen = np.zeros((1, 3)) if missed.all() else xyz[~missed]
    middle = np.round((seen.min(axis=0) + seen.max(axis=0)) / 2.0)
    if np.abs(seen - middle).max() >= 2**31 * SCALE:
        raise ValueError(f"{path}: LAS keeps points to {SCALE} m within 429 km; write these to another format")
    header.scales, header.offsets, header.system_identifier = np.full(3, SCALE), middle, table.frame
    standard = {name.lower() for name in header.point_format.dimension_names}
    stored = {name: name + SUFFIX * (name.lower() in standard) for name in table.names if name not in ("x", "y", "z")}
    header.add_extra_dims([laspy.ExtraBytesParams(to, table.points.dtype[name]) for name, to in stored.items()])
    file = laspy.LasData(header)
    file.xyz = np.where(missed[:, None], middle, xyz)
    file.withheld = missed.astype(np.uint8)
    file.gps_time = np.full(len(table), table.time_s)
    for name, to in stored.items():
        file[to] = table.points[name]
    file.write(path)
