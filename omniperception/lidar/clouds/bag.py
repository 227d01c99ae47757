"""Point clouds in bags of ROS 1 (.bag) and ROS 2 (a folder, or its .db3 file)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from .pointcloud2 import MESSAGE, chosen_topic, table_from_message
from .table import PointTable


def read(path: Path, topic: str | None) -> Iterator[PointTable]:
    """The clouds of a topic, in order of time."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    place = path.parent if path.suffix == ".db3" else path  # a .db3 needs the metadata.yaml beside it
    try:
        with AnyReader([place], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            of_clouds = [c.topic for c in bag.connections if c.msgtype == MESSAGE]
            chosen = chosen_topic(path, of_clouds, topic)
            for connection, _, data in bag.messages([c for c in bag.connections if c.topic == chosen]):
                yield table_from_message(bag.deserialize(data, connection.msgtype))
    except (AnyReaderError, FileNotFoundError) as error:  # the latter from rosbags 0.11 for a folder that is no bag
        raise ValueError(f"{path} is not a readable bag: {str(error).splitlines()[0]}") from error
