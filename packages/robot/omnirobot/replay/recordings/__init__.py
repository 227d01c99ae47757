"""Messages of recordings: MCAP, bags of ROS 2 (a folder, or its .db3 and .mcap files) and of ROS 1 (.bag).

What a killed recorder left, or what lacks a part, is read as far as it goes; one line on standard error says what is
missing and how much was read.
"""

from __future__ import annotations

import importlib
import re
import shutil
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

from .message import Channel, Message

__all__ = ["Channel", "Message", "Recording"]

_READERS = {".mcap": "mcap", ".db3": "db3", ".bag": "rosbag1", ".active": "rosbag1"}
"""Module by suffix; .bag.active is what a killed recorder of ROS 1 leaves."""
_POINTER = b"version https://git-lfs"
"""Begins what lies in a checkout in place of a large file that has not been fetched."""
_ROS_2 = r"[^/'\":\n]+\.(?:db3|mcap)(?:\.zstd)?"
"""Name of a file of a bag of ROS 2."""
_IN_METADATA = re.compile(rf"^\s*-\s*['\"]?(?:[^'\":\n]*/)?({_ROS_2})['\"]?\s*$", re.M)


class Recording:
    """A recording, in the order in which it was written.

    Attributes:
        path: of the file, or of a bag's folder.
        topics: type of each topic that has messages, such as sensor_msgs/msg/Imu, by name.
    """

    def __init__(self, path: Path) -> None:
        """Args: path: an .mcap, .db3 or .bag file, or the folder of a bag of ROS 2.

        Raises:
            ModuleNotFoundError: A library is missing.
            ValueError: It is no recording.
        """
        self.path, self.topics = path, dict[str, str]()
        self._faults: list[str] = []
        self._counts: Counter[str] = Counter()
        self._files = [file for file in self._parts() if self._survey(file)]
        if not self._files or (self._faults and not self.topics):
            raise ValueError(f"{'; '.join(self._faults)}; no message can be read")

    @property
    def missing(self) -> str:
        """What is, to be put behind an error; empty where nothing is known to be."""
        return "".join(f"; {fault}" for fault in self._faults)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Messages of these topics; None: of all. What is missing is said at first, or when it is met."""
        wanted = tuple(self.topics if topics is None else topics)
        if self._faults:
            _say(self._faults, wanted, self._counts)
        faults: list[str] = []
        read: Counter[str] = Counter()
        for file in self._files:
            for message in _messages(file, faults):
                if message.topic in wanted:
                    read[message.topic] += 1
                    yield message
        if met := [fault for fault in faults if fault not in self._faults]:
            _say(met, wanted, read)

    def _parts(self) -> list[Path]:
        """The files, in order."""
        folder = self.path
        if not folder.is_dir():
            return [folder]
        metadata = folder / "metadata.yaml"
        named = _IN_METADATA.findall(metadata.read_text("utf-8", "replace")) if metadata.is_file() else []
        there = sorted((file.name for file in folder.iterdir() if re.fullmatch(_ROS_2, file.name)), key=_by_number)
        if not there:
            raise ValueError(f"{folder} is not a readable bag: .db3 or .mcap files were expected in it")
        found = [name for name in named if name in there]
        if lost := [name for name in named if name not in there]:
            self._faults.append(f"{folder} lacks {', '.join(lost)}, which its metadata.yaml names")
        elif not named:
            self._faults.append(f"{folder} has no readable metadata.yaml, which a recorder writes when it ends")
        if not found and len({Path(name.removesuffix(".zstd")).suffix for name in there}) > 1:
            raise ValueError(f"{self._faults[0]}, and both .db3 and .mcap files; name one of them")
        return [folder / name for name in found or there]

    def _survey(self, file: Path) -> bool:
        """Takes down topics, and how often they come, from a file's index or from all of it; whether it is readable."""
        try:
            with _plain(file) as (reader, plain):
                counts = reader.index(plain)
            if counts is None:
                counts = Counter(message.channel for message in _messages(file, self._faults))
        except ValueError as error:
            self._faults.append(str(error))
            return False
        for channel, count in counts.items():
            if count:
                self.topics[channel.topic] = channel.kind
                self._counts[channel.topic] += count
        return True


def _by_number(name: str) -> list[str | int]:
    """Sorts walk_10 behind walk_9."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def _messages(file: Path, faults: list[str]) -> Iterator[Message]:
    """Of one file."""
    found: list[str] = []
    with _plain(file) as (reader, plain):
        yield from reader.messages(plain, found)
    faults += [f"{file} {fault}" for fault in found]


@contextmanager
def _plain(file: Path) -> Iterator[tuple[ModuleType, Path]]:
    """What reads a file, and the file, unpacked where it is packed as a whole; puts its name before errors."""
    packed = file.suffix.lower() == ".zstd"
    name = file.stem if packed else file.name
    reader = _READERS.get(Path(name).suffix.lower())
    try:
        if reader is None:
            raise ValueError(f"is no recording; {', '.join(_READERS)} or the folder of a bag of ROS 2 were expected")
        if not file.stat().st_size:
            raise ValueError("is empty")
        with file.open("rb") as content:
            if content.read(len(_POINTER)) == _POINTER:
                raise ValueError("is a pointer of Git LFS, not the file itself: run 'git lfs pull' in its checkout")
        module = importlib.import_module(f".{reader}", __name__)
        with TemporaryDirectory() if packed else nullcontext() as folder:
            yield module, file if folder is None else _unpack(file, Path(folder) / name)
    except ValueError as error:
        raise error if str(file) in str(error) else ValueError(f"{file} {error}") from error


def _unpack(source: Path, target: Path) -> Path:
    """As far as it goes: the reader says where it ends."""
    import zstandard

    with source.open("rb") as packed, target.open("wb") as plain:
        try:
            shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(packed), plain)
        except zstandard.ZstdError:
            raise ValueError("is damaged: it does not unpack as zstd") from None
    return target


def _say(faults: Sequence[str], topics: Collection[str], counts: Mapping[str, int]) -> None:
    read = ", ".join(f"{counts[topic]} messages of {topic}" for topic in topics if counts[topic]) or "no message"
    print(f"{'; '.join(faults)}; read: {read}", file=sys.stderr, flush=True)
