"""Drivers' messages as bytes that are laid out by hand."""

import struct


def text(value):
    data = value.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


def point_cloud2(fields, rows, width, frame="livox"):
    """As ROS 2 sends it: header 12.000000007 s, one row."""
    body = struct.pack("<iI", 12, 7) + text(frame) + struct.pack("<II", 1, width) + struct.pack("<I", len(fields))
    for name, offset, kind in fields:
        body += text(name) + struct.pack("<IB3xI", offset, kind, 1)
    body += struct.pack("<B3xII", 0, len(rows) // width, len(rows)) + struct.pack("<I", len(rows)) + rows + b"\1"
    return b"\0\1\0\0" + body


XYZ = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
LIVOX = [*XYZ, ("intensity", 12, 7), ("tag", 16, 2), ("line", 17, 2), ("timestamp", 18, 8)]
