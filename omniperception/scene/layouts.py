"""Layouts: generators of whole worlds of boxes, corridors, mazes, clusters of blocks, cellular automata, as tables."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

ROW = 6
"""Numbers of a row of a table: x, y (m), yaw (rad) and the half extents x, y, z (m) of one box."""


ROUTE_PIECES = 8
"""Pieces of a route from the middle of one cell of a maze to that of the next."""


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


@dataclass(frozen=True)
class MazeLayout:
    """Walls on the edges of a grid of square cells, inside a closed border.

    The robot starts at the origin, in the middle of the first column's middle cell; the goal is the middle of the last
    column's middle cell, which a way always leads to. As the maze that REASAN (Yuan et al. 2025, arXiv 2512.09537)
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
    thickness: Sequence[float] = (0.15, 0.4)
    height: Sequence[float] = (0.3, 2.0)
    depth: float = 0.0
    lanes: Sequence[int] = ()
    worlds: int = 300

    def __post_init__(self) -> None:
        for key in ("thickness", "height"):
            _check_range(self, key)
        object.__setattr__(self, "lanes", tuple(self.lanes))
        if self.columns < 2 or self.rows < 1 or self.rows % 2 == 0:
            raise ValueError(
                f"obstacles: a maze has 2 columns or more and an odd number of rows, not columns={self.columns}"
                f" rows={self.rows}"
            )
        if not self.cell > self.thickness[1]:
            raise ValueError(f"obstacles: cell={self.cell} of a maze must be wider than its walls are thick")
        if any(not 0 <= lane < self.columns for lane in self.lanes):
            raise ValueError(f"obstacles: lanes={list(self.lanes)} of a maze must lie in 0 to {self.columns - 1}")
        _check_not_negative(self, "depth")
        most = min((self.columns - 1) * (self.rows - 1), len(self._inner_edges()))  # a way to every cell leaves so many
        if not 0 <= self.walls <= most:
            raise ValueError(f"obstacles: walls={self.walls} of a maze must lie in 0 to {most}")
        _check_worlds(self)

    @property
    def goal(self) -> tuple[float, float]:
        """Position (m) of the goal."""
        return (self.columns - 1) * self.cell, 0.0

    @property
    def count(self) -> int:
        return self.walls + len(self._border())

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; the inner walls come first, then the border's."""
        return np.stack([self._world(_stream(seed, world)) for world in range(num_worlds)])

    def routes(self, seed: int, num_worlds: int) -> np.ndarray:
        """(num_worlds, R, 2) m: a shortest way through the middles of cells from the robot's to the goal, in
        `ROUTE_PIECES` pieces from one to the next; the goal is repeated up to the length of the longest."""
        ways = [self._walls_and_way(_stream(seed, world))[1] for world in range(num_worlds)]
        longest = max(len(way) for way in ways)
        cells = np.array([way + way[-1:] * (longest - len(way)) for way in ways], dtype=np.float64)
        share = np.arange(ROUTE_PIECES)[:, None] / ROUTE_PIECES
        pieces = cells[:, :-1, None] + share * np.diff(cells, axis=1)[:, :, None]  # (num_worlds, cells, pieces, 2)
        points = np.concatenate((pieces.reshape(num_worlds, -1, 2), cells[:, -1:]), 1)
        return (points - [0, self.rows // 2]) * self.cell

    def _walls_and_way(self, rng: np.random.Generator) -> tuple[list[tuple[int, int, int]], list[tuple[int, int]]]:
        """Edges with a wall, and cells (column, row) from the start's to the goal's."""
        edges = self._inner_edges()
        while True:
            chosen = rng.choice(len(edges), self.walls, replace=False)
            walls = [edges[k] for k in sorted(chosen)]
            way = self._way(walls)
            if way:
                return walls, way

    def _world(self, rng: np.random.Generator) -> np.ndarray:
        walls, _ = self._walls_and_way(rng)
        segments = np.array([self._segment(edge) for edge in walls] + self._border(), dtype=np.float64)
        num = len(segments)
        thickness, height = _draw(rng, self.thickness, num), _draw(rng, self.height, num)
        half_length = segments[:, 3] + thickness / 2  # corners close
        return np.column_stack((segments[:, :3], half_length, thickness / 2, (height + self.depth) / 2))

    def _inner_edges(self) -> list[tuple[int, int, int]]:
        """Edges (column, row, side) where a wall may stand: side 0 to the next column, 1 to the next row."""
        ahead = [(i, j, 0) for i in range(self.columns - 1) for j in range(self.rows)]
        beside = [(i, j, 1) for i in range(self.columns) for j in range(self.rows - 1) if i not in self.lanes]
        return ahead + beside

    def _way(self, walls: Sequence[tuple[int, int, int]]) -> list[tuple[int, int]]:
        """Cells of a shortest way from the start's to the goal's; empty where none leads there."""
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
        way: list[tuple[int, int]] = []
        last = (self.columns - 1, middle) if (self.columns - 1, middle) in before else None
        while last is not None:
            way.append(last)
            last = before[last]
        return way[::-1]

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


@dataclass(frozen=True)
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

    width: Sequence[float] = (2.5, 7.0)
    length: Sequence[float] = (8.0, 16.0)
    back: float = 1.1
    pieces: int = 4
    thickness: Sequence[float] = (0.08, 0.3)
    height: Sequence[float] = (0.6, 2.0)
    lead: float = 1.5
    margin: float = 0.3
    depth: float = 0.0
    worlds: int = 300

    def __post_init__(self) -> None:
        for key in ("width", "length", "thickness", "height"):
            _check_range(self, key)
        for key in ("back", "lead", "margin", "depth"):
            _check_not_negative(self, key)
        if self.pieces < 1:
            raise ValueError(f"obstacles: pieces={self.pieces} of a corridor's wall must be at least 1")
        if not self.width[0] > 2 * self.margin:
            raise ValueError(
                f"obstacles: width={list(self.width)} of a corridor leaves no room with margin={self.margin}"
            )
        if not self.length[0] > self.lead:
            raise ValueError(f"obstacles: length={list(self.length)} of a corridor must be beyond lead={self.lead}")
        _check_worlds(self)

    @property
    def count(self) -> int:
        return 2 * self.pieces + 1

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; the left wall comes first, then the right one, then the one behind."""
        return np.stack([self._world(_stream(seed, world)) for world in range(num_worlds)])

    def areas(self, seed: int, num_worlds: int) -> np.ndarray:
        """(num_worlds, 4) x_low, x_high, y_low, y_high in m: where a world's obstacles are."""
        sizes = [self._size(_stream(seed, world)) for world in range(num_worlds)]
        sides = [width / 2 - self.margin for width, _ in sizes]
        return np.array([(self.lead, length, -y, y) for (_, length), y in zip(sizes, sides, strict=True)])

    def _size(self, rng: np.random.Generator) -> tuple[float, float]:
        """Width and length (m); the first numbers that a world draws."""
        return float(_draw(rng, self.width, 1)[0]), float(_draw(rng, self.length, 1)[0])

    def _world(self, rng: np.random.Generator) -> np.ndarray:
        width, length = self._size(rng)
        half_thickness, half_height = (_draw(rng, key, 1)[0] / 2 for key in (self.thickness, self.height))
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


@dataclass(frozen=True)
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

    area: Sequence[float] = (1.0, 10.0, -3.75, 3.75)
    grid: Sequence[int] = (3, 3)
    side: Sequence[float] = (0.1, 0.3)
    height: Sequence[float] = (0.5, 1.5)
    stagger: float = 0.25
    jitter: float = 0.1
    free: float = 0.0
    depth: float = 0.0
    worlds: int = 300

    def __post_init__(self) -> None:
        for key in ("side", "height"):
            _check_range(self, key)
        object.__setattr__(self, "area", tuple(float(x) for x in self.area))
        object.__setattr__(self, "grid", tuple(self.grid))
        if len(self.area) != 4 or self.area[0] >= self.area[1] or self.area[2] >= self.area[3]:
            raise ValueError(f"obstacles: area={list(self.area)} of blocks must be [x_low, x_high, y_low, y_high]")
        if len(self.grid) != 2 or min(self.grid) < 1:
            raise ValueError(f"obstacles: grid={list(self.grid)} of blocks must be [along x, along y]")
        for key in ("stagger", "jitter", "free", "depth"):
            _check_not_negative(self, key)
        _check_worlds(self)

    @property
    def count(self) -> int:
        return 2 * self.grid[0] * self.grid[1]

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; boxes 2 k and 2 k + 1 are cluster k."""
        return np.stack([self._world(_stream(seed, world)) for world in range(num_worlds)])

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
        side, yaw, beside = _draw(rng, self.side, 1)[0], rng.uniform(-math.pi, math.pi), int(rng.integers(1, 3))
        widths = side * rng.uniform(0.8, 1.2, 2)
        heights = (_draw(rng, self.height, 2) + self.depth) / 2
        half_x = np.array([widths[0], widths[1] * beside / 2])
        local = np.array([[0.0, -widths[0] / 2], [half_x[1] - half_x[0], widths[1] / 2]])
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        return np.column_stack((local @ turn.T, np.full(2, yaw), half_x, widths / 2, heights))


_BARN_BATCHES = 500
"""Batches of 64 worlds of barn that are drawn before the settings count as impossible."""


@dataclass(frozen=True)
class BarnLayout:
    """Cluttered fields from a cellular automaton, as BARN's (Perille et al. 2020, arXiv 2008.13315).

    Published: a grid of 30 x 30 cells of 0.15 m, of which a share is filled at random (0.15, 0.2, 0.25, 0.3) and which
    is then smoothed two, three or four times: a cell with five or more filled neighbours of eight is filled, one with
    one or none is emptied. The outermost rows along the way start filled, and beyond them counts as filled. Worlds
    without a way through for the robot's square footprint of 5 x 5 cells are drawn again; 25 for each of the twelve
    settings make 300. Here cells are 0.2 m, as much larger as the Go2 (0.70 m long) is than the robot there (0.51 m),
    and worlds of more than `boxes` boxes are drawn again, too.

    The robot comes from the origin, and the field begins at x = `lead`; beyond it the way is free again.

    Attributes:
        cells: along x and along y.
        cell: side of a cell (m).
        fill: initial shares.
        smoothing: numbers of smoothing steps.
        robot: cells that the robot's footprint takes to each side of its middle cell.
        lead: see above (m).
        boxes: rows of a world: at most so many boxes cover the filled cells.
        height: range (m) of a box, above the ground.
        depth: see `MazeLayout`.
        worlds: see `Layout`.
    """

    cells: Sequence[int] = (30, 30)
    cell: float = 0.2
    fill: Sequence[float] = (0.15, 0.2, 0.25, 0.3)
    smoothing: Sequence[int] = (2, 3, 4)
    robot: int = 2
    lead: float = 1.5
    boxes: int = 64
    height: Sequence[float] = (0.5, 1.0)
    depth: float = 0.0
    worlds: int = 300

    def __post_init__(self) -> None:
        _check_range(self, "height")
        for key in ("cells", "fill", "smoothing"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        if len(self.cells) != 2 or min(self.cells) < 3:
            raise ValueError(f"obstacles: cells={list(self.cells)} of barn must be [along x, along y], 3 or more")
        if not self.fill or any(not 0 <= share <= 0.5 for share in self.fill):
            raise ValueError(f"obstacles: fill={list(self.fill)} of barn must be shares from 0 to 0.5")
        if not self.smoothing or min(self.smoothing) < 0:
            raise ValueError(f"obstacles: smoothing={list(self.smoothing)} of barn must be numbers of steps")
        if not 0 <= self.robot < self.cells[1] // 2:
            raise ValueError(f"obstacles: robot={self.robot} of barn must be cells, fewer than half the field's width")
        for key in ("cell", "lead"):
            if getattr(self, key) <= 0:
                raise ValueError(f"obstacles: {key}={getattr(self, key)} of barn must be positive")
        if self.boxes < 2:
            raise ValueError(f"obstacles: boxes={self.boxes} of barn must be 2 or more, as both its edges are filled")
        _check_not_negative(self, "depth")
        _check_worlds(self)

    @property
    def count(self) -> int:
        return self.boxes

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; the boxes cover the filled cells of `grids`, some of them twice. It takes seconds, once."""
        return _barn_table(self, seed, num_worlds).copy()

    def make_world(self, seed: int, world: int, num_worlds: int) -> np.ndarray:
        """(boxes, ROW) one world of a table."""
        rng, rows = _stream(seed, world), np.full((self.boxes, ROW), np.nan)
        corners = rectangles(self._grid(rng, world, num_worlds))
        low, high = corners[:, :2] * self.cell, corners[:, 2:] * self.cell
        middle = (low + high) / 2 + [self.lead, -self.cells[1] * self.cell / 2]
        half_height = (_draw(rng, self.height, len(corners)) + self.depth) / 2
        rows[: len(corners)] = np.column_stack((middle, np.zeros(len(corners)), (high - low) / 2, half_height))
        return rows

    def grids(self, seed: int, num_worlds: int) -> np.ndarray:
        """(num_worlds, cells x, cells y) bool: which cells of the worlds of a table are filled."""
        return np.stack([self._grid(_stream(seed, world), world, num_worlds) for world in range(num_worlds)])

    def scores(self, seed: int, num_worlds: int) -> dict[str, np.ndarray]:
        """Difficulty of the worlds of a table by BARN's five measures (see `barn_scores`), and all in one.

        Returns:
            (num_worlds,) for each; `difficulty` is the mean of the five, each less its mean over the worlds and divided
            by its standard deviation, where harder counts as more.
        """
        rows = [barn_scores(grid, self.robot, self.cell) for grid in self.grids(seed, num_worlds)]
        scores = {name: np.array([row[name] for row in rows]) for name in HARDER}
        parts = [sign * _standardized(scores[name]) for name, sign in HARDER.items()]
        return {**scores, "difficulty": np.mean(parts, axis=0)}

    def _grid(self, rng: np.random.Generator, world: int, num_worlds: int) -> np.ndarray:
        settings = list(itertools.product(self.fill, self.smoothing))
        fill, steps = settings[world * len(settings) // num_worlds]
        for batch in (4, 16, *[64] * _BARN_BATCHES):  # of thick ones one in a thousand lets a robot pass
            grids = rng.random((batch, *self.cells)) < fill
            grids[:, :, [0, -1]] = True
            for _ in range(steps):
                grids = smoothed(grids)
            for grid in grids[passable(grids, self.robot)]:
                if len(rectangles(grid)) <= self.boxes:
                    return grid
        raise ValueError(
            f"obstacles: none of {64 * _BARN_BATCHES} worlds of barn with boxes={self.boxes} or fewer lets a robot of"
            f" {2 * self.robot + 1} cells through; lower fill={fill} or robot={self.robot}, or raise boxes"
        )


@lru_cache(maxsize=4)
def _barn_table(layout: BarnLayout, seed: int, num_worlds: int) -> np.ndarray:
    return np.stack([layout.make_world(seed, world, num_worlds) for world in range(num_worlds)])


HARDER = {"closest": -1.0, "visibility": -1.0, "dispersion": 1.0, "dimension": -1.0, "tortuosity": 1.0}
"""BARN's measures, and whether a larger one makes a world harder (1) or easier (-1)."""


def smoothed(grids: np.ndarray) -> np.ndarray:
    """One step of the automaton on (..., nx, ny) bool; beyond the first and last y is filled, beyond x empty."""
    padded = np.zeros((*grids.shape[:-2], grids.shape[-2] + 2, grids.shape[-1] + 2), dtype=np.int8)
    padded[..., 1:-1, 1:-1] = grids
    padded[..., [0, -1]] = 1
    neighbours = _window_sum(padded, 1) - grids
    return (neighbours >= 5) | (grids & (neighbours >= 2))


def _window_sum(padded: np.ndarray, reach: int) -> np.ndarray:
    """Sum (..., nx, ny) over squares of `reach` to each side; `padded` is as much larger all around."""
    width = 2 * reach + 1
    num_x, num_y = padded.shape[-2] - 2 * reach, padded.shape[-1] - 2 * reach
    over_x = np.zeros_like(padded[..., :num_x, :])
    for k in range(width):
        over_x += padded[..., k : k + num_x, :]
    total = np.zeros_like(over_x[..., :num_y])
    for k in range(width):
        total += over_x[..., k : k + num_y]
    return total


def rectangles(grid: np.ndarray) -> np.ndarray:
    """(n, 4) int rectangles x, y, x_end, y_end in cells that together cover the filled cells of (nx, ny) bool.

    Of those that cannot grow, the one that covers most cells not yet covered comes next; so they may overlap.
    """
    corners = _growing_no_more(grid)
    xs, ys = (np.arange(num)[None] for num in grid.shape)
    in_x = (xs >= corners[:, :1]) & (xs < corners[:, 2:3])
    in_y = (ys >= corners[:, 1:2]) & (ys < corners[:, 3:])
    covers = (in_x[:, :, None] & in_y[:, None]).reshape(len(corners), grid.size).astype(np.float32)
    left, chosen = grid.ravel().astype(np.float32), []
    while left.any():
        best = int(np.argmax(covers @ left))
        left *= 1.0 - covers[best]
        chosen.append(best)
    return corners[chosen]


def _growing_no_more(grid: np.ndarray) -> np.ndarray:
    """(n, 4) int, all rectangles x, y, x_end, y_end of filled cells that are part of no larger one."""
    found = []
    for x in range(len(grid)):
        filled = np.logical_and.accumulate(grid[x:], 0)  # (x_end - x - 1, y): filled from x to x_end
        edges = np.diff(np.pad(filled.astype(np.int8), ((0, 0), (1, 1))), axis=1)
        (rows, starts), (_, ends) = np.nonzero(edges == 1), np.nonzero(edges == -1)
        found.append(np.column_stack((np.full(len(rows), x), starts, x + rows + 1, ends)))
    corners = np.concatenate(found)

    def full(x: np.ndarray) -> np.ndarray:
        """Whether the rectangles' cells at x are all filled."""
        inside = (x >= 0) & (x < len(grid))
        along_y = np.pad(grid.cumsum(1), ((0, 0), (1, 0)))[np.clip(x, 0, len(grid) - 1)]
        rows = np.arange(len(x))
        return inside & (along_y[rows, corners[:, 3]] - along_y[rows, corners[:, 1]] == corners[:, 3] - corners[:, 1])

    return corners[~full(corners[:, 0] - 1) & ~full(corners[:, 2])]


def inflated(grids: np.ndarray, cells: int) -> np.ndarray:
    """(..., nx, ny) bool: where the middle of a square of `cells` to each side cannot be; beyond y is filled, beyond x
    free."""
    padded = np.zeros((*grids.shape[:-2], grids.shape[-2] + 2 * cells, grids.shape[-1] + 2 * cells), dtype=np.int16)
    padded[..., :cells] = padded[..., padded.shape[-1] - cells :] = 1
    padded[..., cells : cells + grids.shape[-2], cells : cells + grids.shape[-1]] = grids
    return _window_sum(padded, cells) > 0


def passable(grids: np.ndarray, robot: int) -> np.ndarray:
    """(...) bool: whether a square of `robot` cells to each side gets from the first x of (..., nx, ny) to the last."""
    free = ~inflated(grids, robot)
    maybe = np.asarray(free.any(-1).all(-1))  # somewhere at every x
    free = free[maybe]
    reached = np.zeros_like(free)
    reached[..., 0, :] = free[..., 0, :]
    while True:
        grown = reached.copy()
        grown[..., 1:, :] |= reached[..., :-1, :]
        grown[..., :-1, :] |= reached[..., 1:, :]
        grown[..., 1:] |= reached[..., :-1]
        grown[..., :-1] |= reached[..., 1:]
        grown &= free
        if (grown == reached).all():
            break
        reached = grown
    maybe[maybe] = reached[..., -1, :].any(-1)
    return maybe


def barn_scores(grid: np.ndarray, robot: int, cell: float) -> dict[str, float]:
    """BARN's measures of a world, (nx, ny) bool of cells of `cell` m, on the shortest way through.

    The first four are means over the cells of the shortest way (steps to the eight neighbours, no corner cut) of the
    middle of a robot of `robot` cells to each side, in the grid of cells where it cannot be. BARN's own way bends by at
    most 45 degrees a step and keeps away from obstacles.

    Returns:
        closest: distance (m) to the closest such cell.
        visibility: mean over eight directions of the distance (m) to the first such cell or the field's edge.
        dispersion: how often, around sixteen directions, sight within three cells changes between free and blocked.
        dimension: the shortest of four chords through the cell (m).
        tortuosity: length of the way over the distance between its ends.
    """
    blocked = inflated(grid, robot)
    way = shortest_way(blocked)
    steps = np.hypot(*np.diff(way, axis=0).T)
    chord = math.hypot(*(way[-1] - way[0]))
    taken = np.argwhere(blocked)
    closest = [np.hypot(*(taken - point).T).min() if len(taken) else math.inf for point in way]
    sights = [[_sight(blocked, point, direction) for direction in _EIGHT] for point in way]
    chords = [min(sight[k] + sight[k + 4] for k in range(4)) for sight in sights]
    return {
        "closest": float(np.mean(closest)) * cell,
        "visibility": float(np.mean(sights)) * cell,
        "dispersion": float(np.mean([_dispersion(blocked, point) for point in way])),
        "dimension": float(np.mean(chords)) * cell,
        "tortuosity": float(steps.sum() / chord),
    }


_EIGHT = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""Directions to the neighbours of a cell; k and k + 4 are opposite."""
_SIXTEEN = (
    *((1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1)),
    *((-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1)),
)
_DISPERSION_RADIUS = 3


def _sight(blocked: np.ndarray, point: np.ndarray, direction: tuple[int, int]) -> float:
    """Distance in cells from a free cell to the last free one in a direction."""
    steps, position = 0, point + direction
    while _inside(blocked, position) and not blocked[tuple(position)]:
        steps, position = steps + 1, position + direction
    return steps * math.hypot(*direction)


def _dispersion(blocked: np.ndarray, point: np.ndarray) -> int:
    """Number of changes between free and blocked around the sixteen directions."""

    def sees_obstacle(direction: tuple[int, int]) -> bool:
        stride = max(abs(direction[0]), abs(direction[1]))  # a knight's move counts as two cells
        num_steps = math.ceil(_DISPERSION_RADIUS / stride)
        places = [point + k * np.array(direction) for k in range(1, num_steps + 1)]
        return any(_inside(blocked, place) and bool(blocked[tuple(place)]) for place in places)

    sees = [sees_obstacle(direction) for direction in _SIXTEEN]
    return sum(a != b for a, b in itertools.pairwise([*sees, sees[0]]))


def _inside(grid: np.ndarray, position: np.ndarray) -> bool:
    return 0 <= position[0] < grid.shape[0] and 0 <= position[1] < grid.shape[1]


def shortest_way(blocked: np.ndarray) -> np.ndarray:
    """(n, 2) int cells of a shortest way through free cells of (nx, ny) bool from the first x to the last.

    Raises:
        ValueError: there is none.
    """
    last = len(blocked) - 1
    front = [(0.0, 0, int(y), -1, -1) for y in np.flatnonzero(~blocked[0])]
    before: dict[tuple[int, int], tuple[int, int]] = {}
    while front:
        length, x, y, from_x, from_y = heapq.heappop(front)
        if (x, y) in before:
            continue
        before[x, y] = (from_x, from_y)
        if x == last:
            way = [(x, y)]
            while before[way[-1]] != (-1, -1):
                way.append(before[way[-1]])
            return np.array(way[::-1])
        for dx, dy in _EIGHT:
            to = np.array((x + dx, y + dy))
            if _inside(blocked, to) and not (blocked[x + dx, y + dy] or blocked[x + dx, y] or blocked[x, y + dy]):
                heapq.heappush(front, (length + math.hypot(dx, dy), x + dx, y + dy, x, y))
    raise ValueError("no way leads through this world")


def _standardized(values: np.ndarray) -> np.ndarray:
    spread = values.std()
    return (values - values.mean()) / spread if spread > 0 else np.zeros_like(values)


def _pieces(half: float, longest: float) -> list[tuple[float, float]]:
    """(middle, half length) of equal pieces of [-half, half], none longer than 2 * longest."""
    num = math.ceil(half / longest - 1e-9)
    return [((2 * k + 1) * half / num - half, half / num) for k in range(num)]


def _stream(seed: int, world: int) -> np.random.Generator:
    return np.random.default_rng([seed, world])


def _draw(rng: np.random.Generator, bounds: Sequence[float], num: int) -> np.ndarray:
    return rng.uniform(bounds[0], bounds[1], num)


def _check_range(layout: object, key: str) -> None:
    bounds = tuple(float(bound) for bound in getattr(layout, key))
    object.__setattr__(layout, key, bounds)
    if len(bounds) != 2 or not 0 < bounds[0] <= bounds[1]:
        raise ValueError(
            f"obstacles: {key}={list(bounds)} of a layout must be a range [low, high] with 0 < low <= high"
        )


def _check_not_negative(layout: object, key: str) -> None:
    if getattr(layout, key) < 0:
        raise ValueError(f"obstacles: {key}={getattr(layout, key)} of a layout must not be negative")


def _check_worlds(layout: Layout) -> None:
    if layout.worlds < 1:
        raise ValueError(f"obstacles: worlds={layout.worlds} of a layout must be at least 1")
