"""The layout of ROS's sensor_msgs/PointCloud2."""

from __future__ import annotations

from typing import Any

import numpy as np

from omniperception.common.point_fields import CODES, TYPES

from .table import PointTable

MESSAGE = "sensor_msgs/msg/PointCloud2"
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
    """The points of a message in ROS's own order of rows; fields of several numbers are left out."""
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.count <= 1]
    dtype = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [order + TYPES[field.datatype] for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": message.point_step,
        }
    )
    used = message.width * message.point_step
    data = np.frombuffer(bytes(message.data), np.uint8)
    rows = data.reshape(message.height, -1)[:, :used] if message.height else data.reshape(0, used)
    stamp = message.header.stamp
    time_s = stamp.sec + 1e-9 * stamp.nanosec
    return PointTable(np.ascontiguousarray(rows).reshape(-1).view(dtype), message.header.frame_id, time_s)


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


def chosen_topic(path: object, topics: list[str], topic: str | None) -> str:
    """The topic to read among those with point clouds."""
    if topic is None and len(topics) == 1:
        return topics[0]
    if topic in topics:
        return str(topic)
    if not topics:
        raise ValueError(f"{path} has no topic of type {MESSAGE}")
    asked = "" if topic is None else f"{topic} is none of them; "
    raise ValueError(f"{path} has topics {', '.join(topics)} of type {MESSAGE}; {asked}name one with topic=...")
