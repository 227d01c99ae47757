"""Point clouds in files: tables of named columns, read and written as PCD, PLY, LAS, npz and ROS 2 messages in MCAP.

Libraries of the extra `clouds` do the work where a format is more than a table: pypcd4 to write PCD, laspy for
LAS, mcap for MCAP. Recordings are read by omnirobot's reader: MCAP, and bags of ROS 1 and 2.

Of a file that is cut off or damaged, what can be read is; one line on standard error says what is missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

from .table import PointTable, table_of

__all__ = ["PointTable", "read_points", "read_scans", "table_of", "write_points", "write_scans"]


@dataclass(frozen=True)
class _Format:
    """A file format: the module of this package that knows it, and what it needs from the extra `clouds`."""

    module: str
    library: str = ""
    many: bool = False
    """Whether a file holds several frames."""
    writes: bool = True


FORMATS = {
    ".pcd": _Format("pcd", "pypcd4"),
    ".ply": _Format("ply"),
    ".las": _Format("las", "laspy"),
    ".npz": _Format("npz"),
    ".mcap": _Format("recording", "mcap_ros2", many=True),
    ".laz": _Format("las", "laspy"),
    **dict.fromkeys(
        (".bag", ".active", ".db3", ".zstd", "folder"), _Format("recording", "rosbags", many=True, writes=False)
    ),
}
_POINTER = b"version https://git-lfs"
WRITTEN = tuple(suffix for suffix, form in FORMATS.items() if form.writes)


def read_scans(path: str | Path, topic: str | None = None) -> Iterator[PointTable]:
    """Frames of a file, one after the other; a file of a single cloud is one frame.

    Args:
        path: .pcd, .ply, .las, .laz, .npz, .mcap, .bag (or .bag.active), .db3, or the folder of a ROS 2 bag.
        topic: Of a recording with several topics of point clouds, the one that is read.

    Raises:
        FileNotFoundError: There is no such file.
        ModuleNotFoundError: The library for this format is not installed.
        ValueError: The format is unknown, the file is broken, or the topic has to be named.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give a file of points: {', '.join(FORMATS)}")
    form, module = _format("folder" if path.is_dir() else path.suffix.lower(), path, "read", tuple(FORMATS))
    with _needing(form, path):
        try:
            if form.many:
                yield from module.read(path, topic)
            else:
                _refuse_pointer(path)
                yield module.read(path)
        except ValueError as error:  # of what is read, such as a table without x; named where it is not
            raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error
        except OSError as error:
            raise ValueError(f"{path} cannot be read: {error.strerror}") from error


def read_points(path: str | Path, index: int = 0, topic: str | None = None) -> PointTable:
    """One frame of a file, the first by default. Arguments and errors as ``read_scans``.

    Raises:
        ValueError: The file holds no such frame.
    """
    found = next(islice(read_scans(path, topic), index, None), None)
    if found is None:
        raise ValueError(f"{path} holds no frame number {index} of points")
    return found


def write_points(path: str | Path, table: PointTable) -> None:
    """Writes one frame; the suffix names the format: .pcd, .ply, .las, .npz or .mcap.

    Coordinates that are not finite (misses) stay so, but in LAS, where they lie amid the others with the flag
    "withheld", and come back as NaN. LAS keeps coordinates to 0.1 mm, and the time with the points: that of an empty
    cloud is lost.

    Raises:
        ModuleNotFoundError: The library for this format is not installed.
        ValueError: The format is unknown, or cannot hold these points.
    """
    write_scans(path, [table])


def write_scans(path: str | Path, tables: Sequence[PointTable]) -> None:
    """Writes frames after each other: any number into .mcap, one into the other formats. Errors as ``write_points``."""
    path = Path(path)
    form, module = _format(path.suffix.lower(), path, "written", WRITTEN)
    if len(tables) != 1 and not form.many:
        raise ValueError(f"{path}: this format holds one frame and {len(tables)} were given; write them to .mcap")
    with _needing(form, path):
        module.write(path, tables if form.many else tables[0])


def _refuse_pointer(path: Path) -> None:
    """Says how to fetch a file of which only Git LFS's pointer is there."""
    with path.open("rb") as file:
        if file.read(len(_POINTER)) == _POINTER:
            raise ValueError(f"{path} is a pointer of Git LFS, not the file itself: run 'git lfs pull' in its checkout")


def _format(suffix: str, path: Path, done: str, known: tuple[str, ...]) -> tuple[_Format, Any]:
    if suffix not in known:
        raise ValueError(f"{path}: point clouds are {done} as {', '.join(known)}")
    return FORMATS[suffix], import_module(f".{FORMATS[suffix].module}", __name__)


@contextmanager
def _needing(form: _Format, path: Path) -> Iterator[None]:
    """Names the extra where a format's library is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if not form.library:
            raise
        library = (error.name or form.library).partition(".")[0]
        what = "packages/robot[recordings]" if library == "omnirobot" else "omnilidar[clouds]"
        raise ModuleNotFoundError(f"{path} needs {library}: pip install '{what}'", name=error.name) from None
