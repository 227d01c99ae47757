"""ROS 2's message types."""

from functools import cache
from typing import Any


@cache
def ros_types() -> Any:
    """Those of ROS 2 itself, as a store of rosbags; it takes a second to make."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)
