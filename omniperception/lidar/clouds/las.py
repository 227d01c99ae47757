"""Point clouds as .las files, of surveying programs; columns that LAS does not know are its "extra dimensions"."""

from pathlib import Path

import numpy as np

from .table import PointTable, table_of

SCALE = 1e-4
"""Metres to which coordinates are kept."""
FRAME_BYTES = 32
"""Of the header's system identifier, which holds the name of the frame."""
SUFFIX = "_value"
"""Added to a column whose name LAS gives to a number of another type."""


def read(path: Path) -> PointTable:
    """The points of a file, withheld ones with coordinates that are not a number.

    Columns of LAS's own that are zero throughout are left out. A ``gps_time`` that all points share is the frame's.
    """
    import laspy

    try:
        file = laspy.read(path)
    except laspy.errors.LaspyException as error:
        raise ValueError(f"{path} is not a LAS file: {error}") from error
    shown = np.where(np.asarray(file.withheld, bool), np.nan, 1.0)
    columns = {axis: np.asarray(file[axis], np.float64) * shown for axis in "xyz"}
    extra = set(file.point_format.extra_dimension_names)
    for name in (name for name in file.point_format.dimension_names if name not in ("X", "Y", "Z", "withheld")):
        values = np.asarray(file[name])
        if name in extra or values.any():
            columns[name.removesuffix(SUFFIX) if name in extra else name] = values
    times = np.unique(file["gps_time"] if "gps_time" in file.point_format.dimension_names else np.zeros(1))
    if len(times) == 1 and "gps_time" + SUFFIX not in extra:
        columns.pop("gps_time", None)
    return table_of(columns, file.header.system_identifier.rstrip("\0"), float(times[0]) if len(times) == 1 else 0.0)


def write(path: Path, table: PointTable) -> None:
    """Writes LAS 1.4, coordinates to ``SCALE``."""
    import laspy

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
