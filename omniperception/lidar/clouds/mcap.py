"""Point clouds as ROS 2 messages in an .mcap file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from .pointcloud2 import DEFINITION, MESSAGE, chosen_topic, message_from_table, table_from_message
from .table import PointTable

TOPIC = "/points"


def read(path: Path, topic: str | None) -> Iterator[PointTable]:
    """The clouds of a topic, in order of time."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    try:
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            summary = reader.get_summary()
            channels = summary.channels.values() if summary else ()
            of_clouds = [c.topic for c in channels if summary and summary.schemas[c.schema_id].name == MESSAGE]
            for decoded in reader.iter_decoded_messages(topics=[chosen_topic(path, of_clouds, topic)]):
                yield table_from_message(decoded[3])
    except McapError as error:
        raise ValueError(f"{path} is not a readable MCAP file: {error}") from error


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
