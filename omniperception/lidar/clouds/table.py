"""Points of one frame as a table of named columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


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
