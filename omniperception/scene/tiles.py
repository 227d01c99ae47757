"""Kinds of terrain tiles: heights of one square tile as a function of its difficulty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from omniperception.common.checked import NonNegativePair, Positive, PositivePair, checked


@dataclass(frozen=True)
class TileGrid:
    """The points of a square tile, `half` cells from the middle to each edge.

    Attributes:
        half: cells from the middle to an edge.
        platform: cells from the middle to the edge of the flat square around it, where robots start.
        cell: side of a cell (m).
    """

    half: int
    platform: int
    cell: float

    @property
    def num(self) -> int:
        """Points along a side."""
        return 2 * self.half + 1

    def ring(self) -> np.ndarray:
        """(num, num) int: how many cells a point lies from the tile's edge; the platform counts as its own edge."""
        away = np.abs(np.arange(self.num) - self.half)
        return self.half - np.maximum(np.maximum(away[:, None], away[None, :]), self.platform)

    def around_platform(self) -> np.ndarray:
        """(num, num) bool: which points lie neither on the platform nor on the tile's edge."""
        ring = self.ring()
        return (ring > 0) & (ring < self.half - self.platform)


class Tile(Protocol):
    """A kind of tile. Its edge has height 0, so that tiles fit together.

    Attributes:
        share: of the terrain's columns, in proportion to those of the other kinds.
    """

    @property
    def share(self) -> float: ...

    def heights(self, grid: TileGrid, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """(num, num) heights (m) of a tile of a difficulty in [0, 1]."""


@checked("terrain: ")
class Rough:
    """Uniform noise on a grid, linear in between.

    Attributes:
        height: (easiest, hardest) difference (m) between the lowest and the highest point.
        spacing: of the noise's grid (m).
        share: see `Tile`.
    """

    height: NonNegativePair
    spacing: Positive = 0.2
    share: Positive = 1.0

    def heights(self, grid: TileGrid, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        coarse = np.arange(math.ceil(2 * grid.half * grid.cell / self.spacing) + 1) * self.spacing
        noise = rng.uniform(-0.5, 0.5, (len(coarse), len(coarse))) * _at(self.height, difficulty)
        fine = np.arange(grid.num) * grid.cell
        along = np.stack([np.interp(fine, coarse, row) for row in noise])
        return np.stack([np.interp(fine, coarse, column) for column in along.T], 1) * grid.around_platform()


@checked("terrain: ")
class Slope:
    """A square pyramid with the platform on top, or at the bottom of a pit.

    Attributes:
        angle_deg: (easiest, hardest) inclination of its sides (deg).
        rises: whether the platform is on top.
        share: see `Tile`.
    """

    angle_deg: NonNegativePair
    rises: bool = True
    share: Positive = 1.0

    def __post_init__(self) -> None:
        if self.angle_deg[1] >= 60:
            raise ValueError(f"terrain: angle_deg={list(self.angle_deg)} must stay below 60")

    def heights(self, grid: TileGrid, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        rise = math.tan(math.radians(_at(self.angle_deg, difficulty))) * grid.cell
        return (1.0 if self.rises else -1.0) * rise * grid.ring()


@checked("terrain: ")
class Stairs:
    """A square pyramid of steps with the platform on top, or at the bottom of a pit.

    A riser is one cell deep: what a height field can have for a vertical face.

    Attributes:
        step: (easiest, hardest) height of a step (m).
        tread: depth of a step (m), rounded to whole cells, at least two.
        rises: whether the platform is on top.
        share: see `Tile`.
    """

    step: NonNegativePair
    tread: Positive = 0.3
    rises: bool = True
    share: Positive = 1.0

    def heights(self, grid: TileGrid, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        tread = max(2, round(self.tread / grid.cell))
        return (1.0 if self.rises else -1.0) * _at(self.step, difficulty) * (grid.ring() // tread)


@checked("terrain: ")
class Stones:
    """Rectangular blocks and holes, one over the other.

    Attributes:
        height: (easiest, hardest) height (m) of the highest block, and depth of the deepest hole.
        size: range (m) of their sides.
        count: how many per square metre.
        share: see `Tile`.
    """

    height: NonNegativePair
    size: PositivePair = (0.4, 1.0)
    count: Positive = 1.0
    share: Positive = 1.0

    def heights(self, grid: TileGrid, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        heights, highest = np.zeros((grid.num, grid.num)), _at(self.height, difficulty)
        low, high = self.size
        for _ in range(round(self.count * (2 * grid.half * grid.cell) ** 2)):
            sides = np.maximum(np.round(rng.uniform(low, high, 2) / grid.cell).astype(int), 1)
            row, col = rng.integers(0, grid.num, 2) - sides // 2
            block = slice(max(row, 0), row + sides[0] + 1), slice(max(col, 0), col + sides[1] + 1)
            heights[block] = rng.uniform(-highest, highest)
        return heights * grid.around_platform()


def _at(bounds: Sequence[float], difficulty: float) -> float:
    return bounds[0] + difficulty * (bounds[1] - bounds[0])
