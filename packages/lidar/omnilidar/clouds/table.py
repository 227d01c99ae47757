"""Points of one frame as a table of named columns."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

PADDING = ("", "_")
"""Names of fields that are none, but bytes between the others."""


@dataclass(frozen=True)
class PointTable:
    """Points of one frame, in the order of the file.

    Attributes:
        points: One row per point, (P,), with columns of numbers; x, y and z in metres among them.
        frame: Name of the coordinates' frame; empty where the file does not say.
        time_s: When the frame was taken, s; 0 where the file does not say.
    """

    points: np.ndarray
    frame: str = ""
    time_s: float = 0.0

    def __post_init__(self) -> None:
        names = self.points.dtype.names or ()
        missing = {"x", "y", "z"} - set(names)
        if missing:
            raise ValueError(f"points need columns x, y and z; there are {', '.join(names) or 'none'}")
        if not self.frame.isprintable():
            raise ValueError(f"frame={self.frame!r} must be a name in one line of printable characters")
        object.__setattr__(self, "time_s", float(self.time_s))  # one of NumPy's is written in another way

    @property
    def xyz(self) -> np.ndarray:
        """Coordinates, metres, (P, 3) float64."""
        return np.stack([self.points[axis].astype(np.float64) for axis in "xyz"], axis=1)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return self.points.dtype.names or ()

    def __len__(self) -> int:
        return len(self.points)


def table_of(columns: Mapping[str, np.ndarray], frame: str = "", time_s: float = 0.0) -> PointTable:
    """A table of columns, (P,) each; true and false become 1 and 0 of one byte."""
    stored = {
        name: np.asarray(a, np.uint8) if np.asarray(a).dtype == bool else np.asarray(a) for name, a in columns.items()
    }
    lengths = {len(values) for values in stored.values()}
    if len(lengths) > 1:
        raise ValueError(f"columns of a point cloud must have one length, got {sorted(lengths)}")
    points = np.empty(lengths.pop() if lengths else 0, dtype=[(name, a.dtype) for name, a in stored.items()])
    for name, values in stored.items():
        points[name] = values
    return PointTable(points, frame, time_s)


def column_names(name: str, count: int) -> list[str]:
    """Of a field of so many numbers."""
    return [name] if count == 1 else [f"{name}__{k:04d}" for k in range(count)]


def check_words(path: Path, names: Iterable[str]) -> None:
    """Refuses names of columns that a line of words has no room for.

    Raises:
        ValueError: One is not a word.
    """
    for name in names:
        if len(name.split()) != 1 or name in PADDING:
            raise ValueError(f"{path}: column {name!r} has no name of one word, which {path.suffix} needs; rename it")


def held(path: Path, there: int, told: int, lost: Sequence[str] = ()) -> int:
    """How many of so many points can be read; says so where some are missing, or columns are lost.

    Raises:
        ValueError: None is there.
    """
    if told and not there:
        raise ValueError(f"{path} ends before its first point, {told} were expected")
    if there < told or lost:
        without = f" without {', '.join(lost)}" if lost else ""
        print(f"{path} is cut off: read {min(there, told)} of {told} points{without}", file=sys.stderr, flush=True)
    return min(there, told)


def rows_of_text(path: Path, body: bytes, width: int, told: int) -> list[list[str]]:
    """Words of the lines of so many points; of a file that is cut off, of those before the cut.

    Raises:
        ValueError: A line has not as many words as a point has numbers, or none is there.
    """
    rows = [
        words for line in body.decode("utf-8", "replace").splitlines() if (words := line.split()) and words[0][0] != "#"
    ]
    if len(rows) < told and not body.endswith(b"\n"):
        rows = rows[:-1]  # the cut may have gone through its last number
    rows = rows[: held(path, len(rows), told)]
    for k, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(f"{path}: point {k} has {len(row)} numbers, {width} were expected: {' '.join(row)[:80]}")
    return rows


def numbers(
    path: Path, rows: Sequence[Sequence[str]], columns: Sequence[tuple[str, np.dtype]]
) -> dict[str, np.ndarray]:
    """Columns, (P,) each, of a text's rows, but for padding; whole numbers may be written with a point.

    Raises:
        ValueError: A word is no number of its column.
    """
    return {
        name: _column(path, name, [row[k] for row in rows], kind)
        for k, (name, kind) in enumerate(columns)
        if name not in PADDING
    }


def _column(path: Path, name: str, texts: list[str], dtype: np.dtype) -> np.ndarray:
    try:
        return np.array(texts, dtype)
    except (ValueError, OverflowError):
        made = np.empty(len(texts), dtype)
    for k, text in enumerate(texts):
        try:
            value = float(text)
            made[k] = value
            if dtype.kind in "iu" and made[k] != value:
                raise ValueError
        except (ValueError, OverflowError):
            raise ValueError(f"{path}: {name} of point {k} is {text}, {dtype.name} was expected") from None
    return made
