"""Mazes: walls on the edges of a grid of square cells."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from omniperception.common.checked import AtLeastOne, Counts, NonNegative, PositivePair, checked
from omniperception.scene.layouts.base import draw, stream

ROUTE_PIECES = 8
"""Pieces of a route from the middle of one cell of a maze to that of the next."""


@checked("obstacles: ")
class MazeLayout:
    """Walls on the edges of a grid of square cells, inside a closed border.

    The robot starts at the origin, in the middle of the first column's middle cell; the goal is the middle of the last
    column's middle cell, which a path always leads to. As the maze that REASAN (Yuan et al. 2025, arXiv 2512.09537)
    is tested in: 10 x 5 cells of 2 m, on average 27 of the 85 inner edges with a wall, made of pillars 0.15 to 0.4 m
    thick and 0.3 to 2 m high. There the ten mazes are drawn by hand and the pillars stand up to 0.15 m apart.

    Attributes:
        columns: cells along x.
        rows: cells along y; odd.
        cell: side of a cell (m).
        walls: number of inner edges with a wall; a wall is one box.
        thickness: range (m).
        height: range (m), above the ground.
        depth: how far boxes reach below the ground (m), so that no gap opens under them on slopes; the group's `bottom`
            is its negative.
        lanes: columns in which people walk up and down: no wall across.
        worlds: see `Layout`.
    """

    columns: int = 10
    rows: int = 5
    cell: float = 2.0
    walls: int = 27
    thickness: PositivePair = (0.15, 0.4)
    height: PositivePair = (0.3, 2.0)
    depth: NonNegative = 0.0
    lanes: Counts = ()
    worlds: AtLeastOne = 300

    def __post_init__(self) -> None:
        if self.columns < 2 or self.rows < 1 or self.rows % 2 == 0:
            raise ValueError(
                f"obstacles: a maze has 2 columns or more and an odd number of rows, not columns={self.columns}"
                f" rows={self.rows}"
            )
        if not self.cell > self.thickness[1]:
            raise ValueError(f"obstacles: cell={self.cell} of a maze must be wider than its walls are thick")
        if any(lane >= self.columns for lane in self.lanes):
            raise ValueError(f"obstacles: lanes={list(self.lanes)} of a maze must lie in 0 to {self.columns - 1}")
        most = min((self.columns - 1) * (self.rows - 1), len(self._inner_edges()))  # a path to every cell remains
        if not 0 <= self.walls <= most:
            raise ValueError(f"obstacles: walls={self.walls} of a maze must lie in 0 to {most}")

    @property
    def goal(self) -> tuple[float, float]:
        """Position (m) of the goal."""
        return (self.columns - 1) * self.cell, 0.0

    @property
    def count(self) -> int:
        return self.walls + len(self._border())

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; the inner walls come first, then the border's."""
        return np.stack([self._world(stream(seed, world)) for world in range(num_worlds)])

    def routes(self, seed: int, num_worlds: int) -> np.ndarray:
        """(num_worlds, R, 2) m: a shortest path through the middles of cells from the robot's to the goal, in
        `ROUTE_PIECES` pieces from one to the next; the goal is repeated up to the length of the longest."""
        paths = [self._walls_and_path(stream(seed, world))[1] for world in range(num_worlds)]
        longest = max(len(path) for path in paths)
        cells = np.array([path + path[-1:] * (longest - len(path)) for path in paths], dtype=np.float64)
        share = np.arange(ROUTE_PIECES)[:, None] / ROUTE_PIECES
        pieces = cells[:, :-1, None] + share * np.diff(cells, axis=1)[:, :, None]  # (num_worlds, cells, pieces, 2)
        points = np.concatenate((pieces.reshape(num_worlds, -1, 2), cells[:, -1:]), 1)
        return (points - [0, self.rows // 2]) * self.cell

    def _walls_and_path(self, rng: np.random.Generator) -> tuple[list[tuple[int, int, int]], list[tuple[int, int]]]:
        """Edges with a wall, and cells (column, row) from the start's to the goal's."""
        edges = self._inner_edges()
        while True:
            chosen = rng.choice(len(edges), self.walls, replace=False)
            walls = [edges[k] for k in sorted(chosen)]
            path = self._path(walls)
            if path:
                return walls, path

    def _world(self, rng: np.random.Generator) -> np.ndarray:
        walls, _ = self._walls_and_path(rng)
        segments = np.array([self._segment(edge) for edge in walls] + self._border(), dtype=np.float64)
        num = len(segments)
        thickness, height = draw(rng, self.thickness, num), draw(rng, self.height, num)
        half_length = segments[:, 3] + thickness / 2  # corners close
        return np.column_stack((segments[:, :3], half_length, thickness / 2, (height + self.depth) / 2))

    def _inner_edges(self) -> list[tuple[int, int, int]]:
        """Edges (column, row, side) where a wall may stand: side 0 to the next column, 1 to the next row."""
        ahead = [(i, j, 0) for i in range(self.columns - 1) for j in range(self.rows)]
        beside = [(i, j, 1) for i in range(self.columns) for j in range(self.rows - 1) if i not in self.lanes]
        return ahead + beside

    def _path(self, walls: Sequence[tuple[int, int, int]]) -> list[tuple[int, int]]:
        """Cells of a shortest path from the start's to the goal's; empty where none leads there."""
        closed, middle = set(walls), self.rows // 2
        before: dict[tuple[int, int], tuple[int, int] | None] = {(0, middle): None}
        front = [(0, middle)]  # grows at its end: nearer cells come first
        for i, j in front:
            for cell, edge in (
                ((i + 1, j), (i, j, 0)),
                ((i - 1, j), (i - 1, j, 0)),
                ((i, j + 1), (i, j, 1)),
                ((i, j - 1), (i, j - 1, 1)),
            ):
                inside = 0 <= cell[0] < self.columns and 0 <= cell[1] < self.rows
                if inside and edge not in closed and cell not in before:
                    before[cell] = (i, j)
                    front.append(cell)
        path: list[tuple[int, int]] = []
        last = (self.columns - 1, middle) if (self.columns - 1, middle) in before else None
        while last is not None:
            path.append(last)
            last = before[last]
        return path[::-1]

    def _segment(self, edge: tuple[int, int, int]) -> tuple[float, float, float, float]:
        """(x, y, yaw, half length) of an edge."""
        i, j, side = edge
        x, y = i * self.cell, (j - self.rows // 2) * self.cell
        if side == 0:
            return x + self.cell / 2, y, math.pi / 2, self.cell / 2
        return x, y + self.cell / 2, 0.0, self.cell / 2

    def _border(self) -> list[tuple[float, float, float, float]]:
        """(x, y, yaw, half length) of pieces of the border, two cells long where that goes up."""
        half_x, half_y = self.columns * self.cell / 2, self.rows * self.cell / 2
        middle = half_x - self.cell / 2
        along = [(x + middle, side * half_y, 0.0, half) for side in (-1, 1) for x, half in _pieces(half_x, self.cell)]
        across = [
            (middle + side * half_x, y, math.pi / 2, half) for side in (-1, 1) for y, half in _pieces(half_y, self.cell)
        ]
        return along + across


def _pieces(half: float, longest: float) -> list[tuple[float, float]]:
    """(middle, half length) of equal pieces of [-half, half], none longer than 2 * longest."""
    num = math.ceil(half / longest - 1e-9)
    return [((2 * k + 1) * half / num - half, half / num) for k in range(num)]
