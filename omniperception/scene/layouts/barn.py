"""Cluttered fields from a cellular automaton."""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import Field

from omniperception.common.checked import AsTuple, AtLeastOne, NonNegative, Positive, PositivePair, checked
from omniperception.scene.layouts.base import ROW, draw, stream

_BATCHES = 500
"""Batches of 64 worlds of barn that are drawn before the settings count as impossible."""


_SIDE, _STEPS = Field(ge=3), Field(ge=0)
_Cells = Annotated[tuple[Annotated[int, _SIDE], Annotated[int, _SIDE]], AsTuple, "[along x, along y], 3 or more"]
_Fill = Annotated[
    tuple[Annotated[float, Field(ge=0, le=0.5)], ...], AsTuple, Field(min_length=1), "shares from 0 to 0.5"
]
_Smoothing = Annotated[tuple[Annotated[int, _STEPS], ...], AsTuple, Field(min_length=1), "numbers of steps"]
_Boxes = Annotated[int, Field(ge=2), "2 or more, as both edges of the field are filled"]


@checked("obstacles: ")
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

    cells: _Cells = (30, 30)
    cell: Positive = 0.2
    fill: _Fill = (0.15, 0.2, 0.25, 0.3)
    smoothing: _Smoothing = (2, 3, 4)
    robot: int = 2
    lead: Positive = 1.5
    boxes: _Boxes = 64
    height: PositivePair = (0.5, 1.0)
    depth: NonNegative = 0.0
    worlds: AtLeastOne = 300

    def __post_init__(self) -> None:
        if not 0 <= self.robot < self.cells[1] // 2:
            raise ValueError(f"obstacles: robot={self.robot} of barn must be cells, fewer than half the field's width")

    @property
    def count(self) -> int:
        return self.boxes

    def table(self, seed: int, num_worlds: int) -> np.ndarray:
        """See `Layout`; the boxes cover the filled cells of `grids`, some of them twice. It takes seconds, once."""
        return _barn_table(self, seed, num_worlds).copy()

    def make_world(self, seed: int, world: int, num_worlds: int) -> np.ndarray:
        """(boxes, ROW) one world of a table."""
        rng, rows = stream(seed, world), np.full((self.boxes, ROW), np.nan)
        corners = rectangles(self._grid(rng, world, num_worlds))
        low, high = corners[:, :2] * self.cell, corners[:, 2:] * self.cell
        middle = (low + high) / 2 + [self.lead, -self.cells[1] * self.cell / 2]
        half_height = (draw(rng, self.height, len(corners)) + self.depth) / 2
        rows[: len(corners)] = np.column_stack((middle, np.zeros(len(corners)), (high - low) / 2, half_height))
        return rows

    def grids(self, seed: int, num_worlds: int) -> np.ndarray:
        """(num_worlds, cells x, cells y) bool: which cells of the worlds of a table are filled."""
        return np.stack([self._grid(stream(seed, world), world, num_worlds) for world in range(num_worlds)])

    def _grid(self, rng: np.random.Generator, world: int, num_worlds: int) -> np.ndarray:
        settings = list(itertools.product(self.fill, self.smoothing))
        fill, steps = settings[world * len(settings) // num_worlds]
        for batch in (4, 16, *[64] * _BATCHES):  # of thick ones one in a thousand lets a robot pass
            grids = rng.random((batch, *self.cells)) < fill
            grids[:, :, [0, -1]] = True
            for _ in range(steps):
                grids = smoothed(grids)
            for grid in grids[passable(grids, self.robot)]:
                if len(rectangles(grid)) <= self.boxes:
                    return grid
        raise ValueError(
            f"obstacles: none of {64 * _BATCHES} worlds of barn with boxes={self.boxes} or fewer lets a robot of"
            f" {2 * self.robot + 1} cells through; lower fill={fill} or robot={self.robot}, or raise boxes"
        )


@lru_cache(maxsize=4)
def _barn_table(layout: BarnLayout, seed: int, num_worlds: int) -> np.ndarray:
    return np.stack([layout.make_world(seed, world, num_worlds) for world in range(num_worlds)])


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
