"""Height fields: a regular grid of heights, and the pyramid of extremes under which rays march over it."""

from functools import cached_property

import numpy as np

from .kernels.heightfield import LEVEL_SHIFT
from .kernels.march_block import REACHES


class HeightField:
    """Heights above the plane z = 0 on a regular grid, solid down to there and down to ``base`` below it.

    It is MuJoCo's height field. Point (row, col) of the grid lies at x = -half_x + 2 half_x col / (cols - 1),
    y = -half_y + 2 half_y row / (rows - 1). A cell is two triangles, divided by the diagonal from (row, col) to
    (row + 1, col + 1). The four sides are walls from the surface down to z = 0, and under the whole lies a box of
    thickness ``base`` with walls, bottom and top. Rays hit all of these from both sides, so that a ray that starts
    inside ends at the exit, or at the top of the base. With ``base`` 0 there is no bottom: a ray from below comes in
    and hits the surface from its underside.

    Attributes:
        heights: (rows, cols) float32, in units of ``scale``, >= 0.
        half_x, half_y: Half extents, metres.
        base: Thickness of the box under z = 0, metres.
        scale: Metres per unit of ``heights``.

    Raises:
        ValueError: Fewer than two points along an axis, a height that is negative or not finite, a length <= 0.
    """

    def __init__(
        self, heights: np.ndarray, half_x: float, half_y: float, base: float = 0.0, scale: float = 1.0
    ) -> None:
        self.heights = np.array(heights, dtype=np.float32, order="C")  # its own: what follows from it is kept
        self.half_x, self.half_y, self.base, self.scale = float(half_x), float(half_y), float(base), float(scale)
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise ValueError(f"heights {self.heights.shape} must be (rows, cols) with at least 2 of each")
        if not np.isfinite(self.heights).all():
            raise ValueError(f"heights has {int((~np.isfinite(self.heights)).sum())} values that are not finite")
        if self.heights.min() < 0.0:
            raise ValueError(
                f"heights go down to {self.heights.min():.6g} and must be >= 0: subtract the lowest and put it in "
                "shape.pos"
            )
        lengths = (self.half_x, self.half_y, self.scale)
        if not (min(lengths) > 0.0 and np.isfinite(lengths).all()):
            raise ValueError(f"half_x={half_x}, half_y={half_y} and scale={scale} must be positive and finite")
        if not (self.base >= 0.0 and np.isfinite(self.base)):
            raise ValueError(f"base={base} must be >= 0 and finite")
        low, high = float(self.heights.min()), float(self.heights.max())
        if self.scale * np.abs(self.heights - np.asarray(heights, np.float64)).max() > 1e-3 and high - low < high / 8.0:
            raise ValueError(
                f"heights go from {low:.10g} to {high:.10g}, where float32 loses millimetres: subtract the lowest in"
                " float64 and put it in shape.pos"
            )

    @property
    def half_extents(self) -> tuple[float, float, float]:
        """Half of the smallest box around the frame's origin that holds the field, metres."""
        return self.half_x, self.half_y, max(float(self.heights.max()) * self.scale, self.base)

    @property
    def radius(self) -> float:
        """Radius of a sphere around the frame's origin that holds the field, metres."""
        return float(np.linalg.norm(self.half_extents)) * (1.0 + 1e-6)

    @cached_property
    def pyramid(self) -> tuple[list[np.ndarray], list[int]]:
        """(lowest, highest) of the nodes of each level from 1 on, (nodes, 2) float32, row by row, and their columns.

        In units of ``scale``.
        """
        h = self.heights
        quads = np.stack([h[:-1, :-1], h[1:, :-1], h[:-1, 1:], h[1:, 1:]])
        low, high = quads.min(axis=0), quads.max(axis=0)
        extremes, columns = [], []
        while max(low.shape) > 1:
            low, high = _reduce(low, np.inf).min(axis=(1, 3)), _reduce(high, -np.inf).max(axis=(1, 3))
            extremes.append(np.stack([low, high], axis=-1).reshape(-1, 2))
            columns.append(low.shape[1])
        return extremes, columns

    @cached_property
    def windows(self) -> np.ndarray:
        """Highest points within each of ``REACHES`` cells of each block of 4 x 4 cells, (rows, columns, 4) float32.

        In units of ``scale``.
        """
        h = self.heights
        cells = np.maximum(np.maximum(h[:-1, :-1], h[1:, :-1]), np.maximum(h[:-1, 1:], h[1:, 1:]))
        blocks = _reduce(cells, -np.inf).max(axis=(1, 3))
        halves = _reduce(cells, -np.inf, 2).max(axis=(1, 3))
        halves = np.pad(halves, [(1, 2 * n + 1 - m) for n, m in zip(blocks.shape, halves.shape, strict=True)], "edge")
        first = _highest(halves, 4)[::2, ::2]
        wide = (_highest(np.pad(blocks, r // 4, "edge"), r // 2 + 1) for r in REACHES[1:])
        return np.stack([first, *wide], axis=-1)


def _highest(values: np.ndarray, size: int) -> np.ndarray:
    """Maxima of all windows of ``size`` x ``size``."""
    for axis in (0, 1):
        width = 1
        while width < size:
            shift = min(width, size - width)
            count = values.shape[axis] - shift
            values = np.maximum(values.take(range(count), axis), values.take(range(shift, shift + count), axis))
            width += shift
    return values


def _reduce(values: np.ndarray, fill: float, tile: int = 2**LEVEL_SHIFT) -> np.ndarray:
    """Values in tiles, (rows, tile, columns, tile), filled up at the end."""
    rows, cols = (-(-n // tile) for n in values.shape)
    padded = np.full((rows * tile, cols * tile), fill, np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return padded.reshape(rows, tile, cols, tile)
