"""Corridors of drawn widths and lengths."""

from __future__ import annotations

import numpy as np

from omniperception.common.checked import AtLeastOne, NonNegative, PositivePair, checked
from omniperception.scene.layouts.base import draw, stream


@checked("obstacles: ")
class CorridorLayout:
    """Straight corridors along x around the origin, of drawn widths and lengths, closed behind it and open ahead.

    Obstacle groups without an `area` of their own have that of their world, in place of the preset's: between the walls
    of that corridor.

    Attributes:
        width: range (m) of the distance between the walls.
        length: range (m) of the way from the origin to the end of the walls.
        back: how far (m) behind the origin the corridor is closed.
        pieces: boxes of a side wall, end to end, so that it follows uneven ground.
        thickness: range (m).
        height: range (m), above the ground.
        lead: from where on (m along x) obstacles are, up to the end of the walls.
        margin: distance (m) that obstacles' middles keep from the walls.
        depth: see `MazeLayout`.
        worlds: see `Layout`.
    """

    width: PositivePair = (2.5, 7.0)
    length: PositivePair = (8.0, 16.0)
    back: NonNegative = 1.1
    pieces: AtLeastOne = 4
    thickness: PositivePair = (0.08, 0.3)
    height: PositivePair = (0.6, 2.0)
    lead: NonNegative = 1.5
    margin: NonNegative = 0.3
    depth: NonNegative = 0.0
    worlds: AtLeastOne = 300

    def __post_init__(self) -> None:
        if not self.width[0] > 2 * self.margin:
            raise ValueError(
                f"obstacles: width={list(self.width)} of a corridor leaves no room with margin={self.margin}"
            )
        if not self.length[0] > self.lead:
            raise ValueError(f"obstacles: length={list(self.length)} of a corridor must be beyond lead={self.lead}")

    @property
    def count(self) -> int:
        return 2 * self.pieces + 1

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; the left wall comes first, then the right one, then the one behind."""
        return np.stack([self._world(stream(seed, world)) for world in range(num_worlds)])

    def areas(self, seed: int, num_worlds: int) -> np.ndarray:
        """(num_worlds, 4) x_low, x_high, y_low, y_high in m: where a world's obstacles are."""
        sizes = [self._size(stream(seed, world)) for world in range(num_worlds)]
        sides = [width / 2 - self.margin for width, _ in sizes]
        return np.array([(self.lead, length, -y, y) for (_, length), y in zip(sizes, sides, strict=True)])

    def _size(self, rng: np.random.Generator) -> tuple[float, float]:
        """Width and length (m); the first numbers that a world draws."""
        return float(draw(rng, self.width, 1)[0]), float(draw(rng, self.length, 1)[0])

    def _world(self, rng: np.random.Generator) -> np.ndarray:
        width, length = self._size(rng)
        half_thickness, half_height = (draw(rng, key, 1)[0] / 2 for key in (self.thickness, self.height))
        half, rows = (length + self.back) / (2 * self.pieces), []
        for side in (1, -1):
            for k in range(self.pieces):
                x, y = (2 * k + 1) * half - self.back, side * (width / 2 + half_thickness)
                rows.append((x, y, 0.0, half, half_thickness, half_height))
        rows.append(
            (-self.back - half_thickness, 0.0, 0.0, half_thickness, width / 2 + 2 * half_thickness, half_height)
        )
        table = np.array(rows)
        table[:, 5] += self.depth / 2
        return table
