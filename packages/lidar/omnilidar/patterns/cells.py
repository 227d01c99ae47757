"""Cells of nearly equal solid angle, in which the directions of a pattern are counted."""

import math
from dataclasses import dataclass

import numpy as np

from .table import ScanPattern


@dataclass(frozen=True)
class SphereCells:
    """The sphere in rings of equal height in elevation, each cut into cells about as wide as they are high.

    Attributes:
        edge_deg: Height of a ring; the next smaller one that divides 180 deg is used.
    """

    edge_deg: float

    def __post_init__(self) -> None:
        if not 0.0 < self.edge_deg <= 90.0:
            raise ValueError(f"cell_deg={self.edge_deg} must be in 0..90")

    @property
    def columns(self) -> np.ndarray:
        """Cells of each ring, from the lowest, (num_rings,) int64."""
        rings = math.ceil(180.0 / self.edge_deg - 1e-9)
        middle = math.pi * ((np.arange(rings) + 0.5) / rings - 0.5)
        return np.maximum(1, np.round(2.0 * rings * np.cos(middle))).astype(np.int64)

    @property
    def num_cells(self) -> int:
        """Cells of the whole sphere."""
        return int(self.columns.sum())

    def index(self, elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        """Cell of each direction given in rad, in 0..num_cells-1."""
        return self.locate(elevation, azimuth)[0]

    def locate(self, elevation: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cell of each direction given in rad, and its squared distance from the cell's centre in cell widths."""
        columns = self.columns
        first = np.cumsum(columns) - columns
        up = (elevation / math.pi + 0.5) * len(columns)
        ring = np.clip(np.floor(up), 0, len(columns) - 1).astype(np.int64)
        along = np.mod(azimuth / (2.0 * math.pi), 1.0) * columns[ring]
        column = np.minimum(along.astype(np.int64), columns[ring] - 1)
        return first[ring] + column, (up - ring - 0.5) ** 2 + (along - column - 0.5) ** 2

    def of(self, pattern: ScanPattern) -> np.ndarray:
        """Cell of each row of a pattern, (M,) int64."""
        return self.index(pattern.elevation.double().cpu().numpy(), pattern.azimuth.double().cpu().numpy())
