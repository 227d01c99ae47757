"""Clusters of blocks on a staggered grid."""

from __future__ import annotations

import math

import numpy as np

from omniperception.common.checked import Area, AtLeastOne, Cells, NonNegative, PositivePair, checked
from omniperception.scene.layouts.base import ROW, draw, stream


@checked("obstacles: ")
class BlocksLayout:
    """Clusters of blocks on a staggered grid: each two boxes side by side.

    As the scattered worlds that REASAN (Yuan et al. 2025, arXiv 2512.09537) is tested in: clusters of three or four
    square pillars with sides of 0.1 to 0.3 m, 0.5 to 1.5 m high, that stand beside each other in a 2 x 2 square, on
    3 x 3 (sparse) or 4 x 4 (dense) places in 9 x 7.5 m. Here pillars that touch are one box.

    Attributes:
        area: (x_low, x_high, y_low, y_high) m of the grid.
        grid: clusters along x and along y.
        side: range (m) of the pillars' sides.
        height: range (m), above the ground.
        stagger: every other column is shifted by this share of a place's width to one side, the rest to the other.
        jitter: clusters are shifted by up to this (m) along x and y.
        free: clusters nearer to the origin than this (m) are left out.
        depth: see `MazeLayout`.
        worlds: see `Layout`.
    """

    area: Area = (1.0, 10.0, -3.75, 3.75)
    grid: Cells = (3, 3)
    side: PositivePair = (0.1, 0.3)
    height: PositivePair = (0.5, 1.5)
    stagger: NonNegative = 0.25
    jitter: NonNegative = 0.1
    free: NonNegative = 0.0
    depth: NonNegative = 0.0
    worlds: AtLeastOne = 300

    @property
    def count(self) -> int:
        return 2 * self.grid[0] * self.grid[1]

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; boxes 2 k and 2 k + 1 are cluster k."""
        return np.stack([self._world(stream(seed, world)) for world in range(num_worlds)])

    def _world(self, rng: np.random.Generator) -> np.ndarray:
        num_x, num_y = self.grid
        pitch_x, pitch_y = (self.area[1] - self.area[0]) / num_x, (self.area[3] - self.area[2]) / num_y
        column, row = (index.ravel() for index in np.mgrid[:num_x, :num_y])
        shift = np.where(column % 2 == 1, 1.0, -1.0) * self.stagger * pitch_y
        x = self.area[0] + (column + 0.5) * pitch_x + rng.uniform(-self.jitter, self.jitter, len(column))
        y = self.area[2] + (row + 0.5) * pitch_y + shift + rng.uniform(-self.jitter, self.jitter, len(row))
        clusters = np.stack([self._cluster(rng) for _ in column])  # (clusters, 2, ROW), around the origin
        clusters[..., 0] += x[:, None]
        clusters[..., 1] += y[:, None]
        clusters[np.hypot(x, y) < self.free] = np.nan
        return clusters.reshape(-1, ROW)

    def _cluster(self, rng: np.random.Generator) -> np.ndarray:
        """(2, ROW) two boxes: a row of two pillars, and beside it one or two."""
        side, yaw, beside = draw(rng, self.side, 1)[0], rng.uniform(-math.pi, math.pi), int(rng.integers(1, 3))
        widths = side * rng.uniform(0.8, 1.2, 2)
        heights = (draw(rng, self.height, 2) + self.depth) / 2
        half_x = np.array([widths[0], widths[1] * beside / 2])
        local = np.array([[0.0, -widths[0] / 2], [half_x[1] - half_x[0], widths[1] / 2]])
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        return np.column_stack((local @ turn.T, np.full(2, yaw), half_x, widths / 2, heights))
