"""Tiles of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omniperception.scene.tiles import TileGrid


@dataclass(frozen=True)
class Waves:
    """Waves along x.

    Attributes:
        share: of the terrain's columns, in proportion to those of the other kinds.
        height: (easiest, hardest) difference (m) between the lowest and the highest point.
        length: of a wave (m).
    """

    share: float
    height: Sequence[float]
    length: float = 1.0

    def heights(self, grid: TileGrid, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """(num, num) heights (m) of a tile of a difficulty in [0, 1]; its edge and its platform are flat."""
        low, high = self.height
        x = (np.arange(grid.num) - grid.half) * grid.cell
        wave = 0.5 * (low + difficulty * (high - low)) * np.sin(2 * np.pi * x / self.length)
        return np.where(grid.around_platform(), wave[:, None], 0.0)
