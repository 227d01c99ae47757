"""What layouts have in common: the table of worlds, random streams, checks of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

ROW = 6
"""Numbers of a row of a table: x, y (m), yaw (rad) and the half extents x, y, z (m) of one box."""


class Layout(Protocol):
    """A generator of worlds of boxes.

    Attributes:
        worlds: how many worlds a table has.
    """

    @property
    def worlds(self) -> int: ...

    @property
    def count(self) -> int:
        """Rows K of every world."""

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """(num_worlds, K, ROW) float64, environment frame; a row of NaN stands for no box. World i depends on the seed,
        i and nothing else but, for `BarnLayout`, `num_worlds`."""


def stream(seed: int, world: int) -> np.random.Generator:
    return np.random.default_rng([seed, world])


def draw(rng: np.random.Generator, bounds: Sequence[float], num: int) -> np.ndarray:
    return rng.uniform(bounds[0], bounds[1], num)
