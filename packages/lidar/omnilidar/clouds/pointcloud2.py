"""The layout of ROS's sensor_msgs/PointCloud2."""

from __future__ import annotations

from typing import Any

import numpy as np

from .table import PADDING, PointTable, column_names

MESSAGE = "sensor_msgs/msg/PointCloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's names of PointField's datatypes INT8 to FLOAT64, without byte order."""
CODES = {np.dtype(kind): code for code, kind in TYPES.items()}
DEFINITION = """\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/PointField
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"""


def table_from_message(message: Any) -> PointTable:
    """The points of a message in ROS's own order of rows; ``name__0000``, ... of a field of several numbers.

    Raises:
        ValueError: The message is cut off, or its fields have no layout.
    """
    order = ">" if message.is_bigendian else "<"
    height, width, step = message.height, message.width, message.point_step
    names, formats, offsets = [], [], []
    for field in (field for field in message.fields if field.name not in PADDING):
        if field.datatype not in TYPES:
            raise ValueError(f"PointCloud2: field {field.name} is of type {field.datatype}, expected {list(TYPES)}")
        kind, count = np.dtype(order + TYPES[field.datatype]), max(field.count, 1)
        if field.offset + kind.itemsize * count > step or field.name in names:
            raise ValueError(
                f"PointCloud2: field {field.name} is there twice, or ends behind the {step} bytes of a point"
            )
        names += column_names(field.name, count)
        formats += [kind] * count
        offsets += [field.offset + kind.itemsize * k for k in range(count)]
    row_step = message.row_step if height > 1 and message.row_step > width * step else width * step
    data, needed = bytes(message.data), (height - 1) * row_step + width * step if height and width else 0
    if len(data) < needed:
        raise ValueError(f"PointCloud2: {needed} bytes of {height} x {width} points were expected, {len(data)} given")
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    points = np.ndarray((height, width), dtype, data, strides=(row_step, step)).reshape(-1)
    stamp = message.header.stamp
    return PointTable(points, message.header.frame_id, stamp.sec + 1e-9 * stamp.nanosec)


def message_from_table(table: PointTable) -> dict:
    """A message as nested dictionaries, one row of points."""
    dtype = np.dtype([(name, table.points.dtype[name].newbyteorder("<")) for name in table.names])
    unknown = [name for name in table.names if table.points.dtype[name].newbyteorder("=") not in CODES]
    if unknown:
        raise ValueError(f"PointCloud2 has no type for column {unknown[0]} of {table.points.dtype[unknown[0]]}")
    types = [table.points.dtype[name] for name in table.names]
    offsets = np.cumsum([0, *(kind.itemsize for kind in types)]).tolist()
    fields = [
        {"name": name, "offset": offset, "datatype": CODES[kind.newbyteorder("=")], "count": 1}
        for name, offset, kind in zip(table.names, offsets[:-1], types, strict=True)
    ]
    seconds = int(table.time_s // 1.0)
    carried, nanoseconds = divmod(round((table.time_s - seconds) * 1e9), 10**9)
    stamp = {"sec": seconds + carried, "nanosec": nanoseconds}
    return {
        "header": {"stamp": stamp, "frame_id": table.frame},
        "height": 1,
        "width": len(table),
        "fields": fields,
        "is_bigendian": False,
        "point_step": dtype.itemsize,
        "row_step": dtype.itemsize * len(table),
        "data": table.points.astype(dtype).tobytes(),
        "is_dense": bool(np.isfinite(table.xyz).all()),
    }
