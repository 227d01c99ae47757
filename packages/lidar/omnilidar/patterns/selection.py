"""Selection of points where fewer rays are kept of a frame than the device measures."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch

from .table import ScanPattern

Strategy = Literal["every_kth", "stratified"]

MAX_STRATIFIED_VARIANTS = 256
DISTINCT_FRAMES = 16
"""Choices of a stratified bank where the table repeats after fewer frames, as that of a spinning sensor does."""
MAX_OFFSETS = 1 << 22
"""Bound on variants x points of which a stratified bank is chosen."""
FIELD_SAMPLE = 50_000
"""Rows of the table from which the size of the field of view is found."""


@dataclass(frozen=True)
class SphereCells:
    """The sphere in rings of equal height in elevation, each cut into cells about as wide as they are high.

    Attributes:
        edge_deg: Height of a ring; the next smaller one that divides 180 deg is used.
    """

    edge_deg: float

    @property
    def columns(self) -> np.ndarray:
        """Cells of each ring, from the lowest, (num_rings,) int64."""
        rings = math.ceil(180.0 / self.edge_deg - 1e-9)
        middle = math.pi * ((np.arange(rings) + 0.5) / rings - 0.5)
        return np.maximum(1, np.round(2.0 * rings * np.cos(middle))).astype(np.int64)

    def index(self, elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        """Cell of each direction given in rad, in 0..columns.sum()-1."""
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


@dataclass(frozen=True)
class Selection:
    """A bank of choices of N among the P points of a frame.

    Ray i of a frame is row ``(first_row + offsets[variant, i]) mod M`` of the pattern's table, where ``first_row`` is
    what ``ScanPattern.first_rows`` gives and ``variant`` what ``variants`` gives. Nothing else is kept from frame to
    frame: a reset, a pause or a replay at the same time and frame number gives the same points.

    Attributes:
        strategy: "every_kth" or "stratified".
        offsets: Rows after the frame's first, increasing, in 0..P-1, (V, N) int32.
        num_rows: Rows of the pattern's table, M.
        phase_step: Phases of environments should be multiples of this many rows. It divides M. For "stratified" it is
            the distance between the frames that the variants were made for (a frame that begins in between gets the
            nearest one's offsets, and its cells are filled less evenly), whole shots where a frame is; otherwise the
            rows of one shot.
    """

    strategy: Strategy
    offsets: torch.Tensor
    num_rows: int
    phase_step: int

    @property
    def num_variants(self) -> int:
        """V."""
        return self.offsets.shape[0]

    @property
    def num_rays(self) -> int:
        """N."""
        return self.offsets.shape[1]

    def draw_phases(self, num_envs: int, generator: torch.Generator | None = None) -> torch.Tensor:
        """Random rows by which each environment's device is ahead, multiples of ``phase_step``, (num_envs,) int64."""
        steps = self.num_rows // self.phase_step
        return torch.randint(steps, (num_envs,), generator=generator) * self.phase_step

    def variants(self, first_row: torch.Tensor, frame: torch.Tensor, out: torch.Tensor | None = None) -> torch.Tensor:
        """Variant of each environment's frame; allocates nothing if given ``out``.

        The bank holds the variants of all starts for one choice, then those for the next choice.

        Args:
            first_row: Of each frame, (num_envs,) int64.
            frame: Number of the frame, one for all (1,) or (num_envs,), any integer type.
            out: Where to write, (num_envs,) int64.

        Returns:
            ``out``, in 0..V-1.
        """
        out = torch.empty_like(first_row) if out is None else out
        if self.num_variants == 1:
            return out.zero_()
        starts = self.num_rows // self.phase_step
        torch.add(first_row, self.phase_step // 2, out=out)
        out.floor_divide_(self.phase_step).remainder_(starts)
        return out.add_(frame, alpha=starts).remainder_(self.num_variants)


def make_selection(
    pattern: ScanPattern, period_s: float, num_rays: int, strategy: Strategy = "every_kth", seed: int = 0
) -> Selection:
    """The bank of a strategy.

    Args:
        pattern: The device's table.
        period_s: Length of a frame, s.
        num_rays: Points kept of each frame.
        strategy: "every_kth": every k-th point from the frame's first, k having no factor in common with the number of
            lasers; one variant. The last P - k N points of each frame are never kept: where a frame is a whole turn
            of a spinning sensor, that is always the same sector. "stratified": cells of the field of view, of equal
            solid angle and about as many as rays, each give their most central point, then another, until there are
            enough; one variant, with the cells shifted at random, for each of at most 256 places in the table where a
            frame can begin, and several where few frames differ.
        seed: Of the random choices.
    """
    points = pattern.check_num_rays(period_s, num_rays)
    if strategy == "every_kth":
        offsets = (torch.arange(num_rays) * pattern.stride(period_s, num_rays))[None]
        return Selection(strategy, offsets.int(), pattern.num_rows, pattern.rows_per_shot)
    if strategy == "stratified":
        variants = min(MAX_STRATIFIED_VARIANTS, max(1, MAX_OFFSETS // points))
        frames = pattern.num_rows // math.gcd(pattern.num_rows, points)
        choices = 1 if num_rays == points else min(variants, math.ceil(DISTINCT_FRAMES / frames))
        shot = pattern.rows_per_shot if points % pattern.rows_per_shot == 0 else 1
        step = _frame_step(pattern.num_rows // shot, points // shot, variants // choices) * shot
        offsets = _stratified_offsets(pattern, points, num_rays, step, choices, seed)
        return Selection(strategy, offsets, pattern.num_rows, step)
    raise ValueError(f"lidar.selection={strategy!r} must be one of {', '.join(get_args(Strategy))}")


def _frame_step(num_rows: int, points: int, max_variants: int) -> int:
    """Smallest divisor of the table, and of the frame if possible, that makes at most ``max_variants`` steps of it.

    All are numbers of shots. Frames of a device whose phase is a multiple of such a step begin at multiples of it.
    """
    for base in (math.gcd(num_rows, points), num_rows):
        if num_rows // base <= max_variants:
            pieces = max(k for k in _divisors(base) if k * (num_rows // base) <= max_variants)
            return base // pieces
    raise AssertionError("a table is one step of itself")


def _divisors(number: int) -> list[int]:
    small = [k for k in range(1, math.isqrt(number) + 1) if number % k == 0]
    return small + [number // k for k in small]


def _stratified_offsets(
    pattern: ScanPattern, points: int, num_rays: int, step: int, choices: int, seed: int
) -> torch.Tensor:
    elevation, azimuth = (a.double().cpu().numpy() for a in (pattern.elevation, pattern.azimuth))
    cells = field_cells(pattern, num_rays)
    random = np.random.default_rng(seed)
    chosen = []
    for start in list(range(0, pattern.num_rows, step)) * choices:
        rows = np.arange(start, start + points)
        turned = azimuth.take(rows, mode="wrap") + 2.0 * math.pi * random.random()
        tilted = elevation.take(rows, mode="wrap") + math.radians(cells.edge_deg) * (random.random() - 0.5)
        chosen.append(_one_per_cell(*cells.locate(tilted, turned), num_rays, random))
    return torch.from_numpy(np.stack(chosen).astype(np.int32))


def field_cells(pattern: ScanPattern, count: int) -> SphereCells:
    """Cells of equal solid angle, about ``count`` of which the pattern's table touches."""
    rows = np.random.default_rng(0).permutation(pattern.num_rows)[:FIELD_SAMPLE]
    elevation, azimuth = (a.double().cpu().numpy()[rows] for a in (pattern.elevation, pattern.azimuth))
    small, large = 0.05, 90.0
    while large > 1.02 * small:
        edge = math.sqrt(small * large)
        touched = len(np.unique(SphereCells(edge).index(elevation, azimuth)))
        small, large = (edge, large) if touched > count else (small, edge)
    return SphereCells(large)


def _one_per_cell(cell: np.ndarray, off_centre: np.ndarray, num_rays: int, random: np.random.Generator) -> np.ndarray:
    """Positions of ``num_rays`` points, increasing: the most central of every cell, then the next of every cell, ..."""
    by_cell = np.lexsort((off_centre, cell))
    sorted_cells = cell[by_cell]
    turn = np.arange(len(cell)) - np.searchsorted(sorted_cells, sorted_cells)
    taken = np.lexsort((random.random(len(cell)), turn))[:num_rays]
    return np.sort(by_cell[taken])
