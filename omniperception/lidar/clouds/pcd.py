"""Point clouds as .pcd files, of the Point Cloud Library; written binary."""

from pathlib import Path

import numpy as np

from .table import PointTable

FIRST_LINE = "# .PCD v0.7 - Point Cloud Data file format"
"""Of every file; what follows in ours is the frame and the time, a comment to other programs."""


def read(path: Path) -> PointTable:
    """The points of a file: text, binary or compressed."""
    from pypcd4 import PointCloud

    with path.open("rb") as file:
        first = file.readline().decode("utf-8", "replace").rstrip("\r\n")
    try:
        cloud = PointCloud.from_path(path)
        points = np.empty(cloud.points, dtype=list(zip(cloud.fields, cloud.types, strict=True)))
        for name in cloud.fields:
            points[name] = cloud.pc_data[name]
    except Exception as error:  # pypcd4 raises whatever its parsing meets
        raise ValueError(f"{path} is not a PCD file: {str(error).splitlines()[0]}") from error
    return PointTable(points, *_said(first))


def write(path: Path, table: PointTable) -> None:
    """Writes a binary file."""
    from pypcd4 import Encoding, PointCloud

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
