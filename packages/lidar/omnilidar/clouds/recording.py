"""Point clouds in recordings: read from .mcap files and bags of ROS 1 and 2, written as .mcap."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .pointcloud2 import DEFINITION, MESSAGE, message_from_table, table_from_message
from .table import PointTable

if TYPE_CHECKING:
    from omnirobot.replay.recordings import Message, Recording

TOPIC = "/points"


def read(path: Path, topic: str | None) -> Iterator[PointTable]:
    """The clouds of a topic, in the order of the recording; omnirobot reads it, which nothing else here needs."""
    from omnirobot.replay.recordings import Recording

    recording = Recording(path)
    for message in recording.messages([_chosen(recording, topic)]):
        yield _table(message)


def _table(message: Message) -> PointTable:
    if message.kind == MESSAGE:
        return table_from_message(message.decode())
    from omnirobot.wire import custom_msg

    given = custom_msg.read(message.data)
    return PointTable(given.points, given.frame, 1e-9 * given.stamp_ns)


def _chosen(recording: Recording, topic: str | None) -> str:
    """The topic to read among those with point clouds."""
    from omnirobot.wire import custom_msg

    path, topics, missing = recording.path, recording.topics, recording.missing
    of_clouds = [name for name, kind in topics.items() if kind == MESSAGE or custom_msg.KIND.fullmatch(kind)]
    if topic is None and len(of_clouds) == 1:
        return of_clouds[0]
    if topic in of_clouds:
        return str(topic)
    if not of_clouds:
        there = ", ".join(f"{name} ({kind})" for name, kind in topics.items()) or "none"
        raise ValueError(
            f"{path} has no topic of type {MESSAGE} or Livox's CustomMsg with messages; its topics: {there}{missing}"
        )
    asked = "" if topic is None else f"{topic} is none of them; "
    raise ValueError(f"{path} has topics {', '.join(of_clouds)} with clouds; {asked}name one with topic=...{missing}")


def write(path: Path, tables: Sequence[PointTable]) -> None:
    """Writes the tables as messages on ``TOPIC``, each at its own time; where that fails, an older file stays."""
    from mcap_ros2.writer import Writer

    half = path.with_name(f".{path.name}.tmp")
    try:
        with half.open("wb") as file, Writer(file) as writer:
            schema = writer.register_msgdef(MESSAGE, DEFINITION)
            for table in tables:
                if table.time_s < 0.0:
                    raise ValueError(f"{path}: MCAP keeps times from 0, and time_s={table.time_s} was given")
                now = round(table.time_s * 1e9)
                writer.write_message(TOPIC, schema, message_from_table(table), log_time=now, publish_time=now)
        half.replace(path)
    finally:
        half.unlink(missing_ok=True)
