"""The layout of Livox's CustomMsg, which all its drivers share."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

import numpy as np

KIND = re.compile(r"livox\w*/msg/CustomMsg")
"""Its type: of livox_ros_driver2, or of a driver before it (livox_ros_driver, livox_interfaces)."""
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "offset_time", "reflectivity", "tag", "line"],
        "formats": ["<f4", "<f4", "<f4", "<u4", "u1", "u1", "u1"],
        "offsets": [4, 8, 12, 0, 16, 17, 18],
        "itemsize": 20,
    }
)
"""A point in CDR: m, ns, the rest as the sensor gives it."""


@dataclass(frozen=True)
class CustomMsg:
    """A message.

    Attributes:
        stamp_ns: of its header.
        frame: likewise.
        base_ns: time from which points' offsets are counted.
        points: (n,) POINT.
    """

    stamp_ns: int
    frame: str
    base_ns: int
    points: np.ndarray


def read(data: bytes) -> CustomMsg:
    """A message in CDR.

    Raises:
        ValueError: It is cut off, or big-endian.
    """
    try:
        if data[:2] != b"\0\1":
            raise ValueError(f"CustomMsg: little-endian CDR was expected, {data[:4].hex()} given")
        body = memoryview(data)[4:]
        seconds, nanoseconds, length = struct.unpack_from("<iII", body)
        frame = bytes(body[12 : 12 + length]).rstrip(b"\0").decode("utf-8", "replace")
        at = -(-(12 + length) // 8) * 8
        base_ns, count = struct.unpack_from("<Q8xI", body, at)
    except struct.error:
        raise ValueError("CustomMsg: cut off") from None
    part = bytes(body[at + 20 :])
    if len(part) < 20 * count - 1:  # nothing follows the last point's 19 bytes
        raise ValueError("CustomMsg: cut off")
    points = np.frombuffer(part.ljust(20 * count, b"\0"), POINT, count)
    return CustomMsg(seconds * 10**9 + nanoseconds, frame, base_ns, points)
