"""What scans see: cells of the sphere that rays touch, and the largest angle that they leave."""

import math

import numpy as np
import torch

from omnilidar import ScanPattern
from omnilidar.patterns.cells import SphereCells

WINDOWS = 4
"""Windows of a pattern over which shares are averaged, evenly placed."""


def compare(model, table, seconds, cell_deg=2.0):
    """(overlap, seen by the model, seen by the table) of windows of so many seconds.

    The overlap is the sum over cells of the smaller of both shares of points: 1 for the same counts. Seen are fractions
    of the cells that the whole table touches.
    """
    cells = SphereCells(cell_deg)
    field = np.unique(cells.of(table))
    rows = []
    for start in np.linspace(0.0, max(0.0, min(model.duration_s, table.duration_s) - seconds), WINDOWS):
        a, b = (cell_share(pattern, start, seconds, cells) for pattern in (model, table))
        rows.append((np.minimum(a, b).sum(), (a[field] > 0).mean(), (b[field] > 0).mean()))
    return np.mean(rows, axis=0)


def cell_share(pattern, start_s, seconds, cells):
    """Share of the points of [start_s, start_s + seconds) in each cell, (num_cells,), which sums to 1."""
    first = math.ceil(start_s * pattern.points_per_second - 1e-3)
    rows = (first + torch.arange(pattern.points_per_frame(seconds))) % pattern.num_rows
    counts = np.bincount(cells.of(_take(pattern, rows)), minlength=cells.num_cells)
    return counts / counts.sum()


def angle_to_table(model, table, slack_rows=0):
    """Mean and largest angle from rows of the table to the model's same rows, degrees; 10,000 rows, evenly placed.

    With `slack_rows`, to the nearest of the model's rows that are at most so many before or after: for a model whose
    order of firing drifts from the table's.
    """
    last = min(model.num_rows, table.num_rows) - 1 - slack_rows
    rows = torch.linspace(slack_rows, last, 10_000 if slack_rows == 0 else 1_000, dtype=torch.float64).round().long()
    near = rows[:, None] + torch.arange(-slack_rows, slack_rows + 1)
    gap = model.directions_s[near].double() - table.directions_s[rows, None].double()
    chord = torch.linalg.vector_norm(gap, dim=2).amin(dim=1)
    angle = torch.rad2deg(2.0 * torch.asin((chord / 2.0).clamp(max=1.0)))
    return float(angle.mean()), float(angle.max())


def selection_coverage(pattern, selection, period_s, seconds, cell_deg):
    """(seen, gap) of an environment's frames over so many seconds: the fraction of the pattern's cells with a ray, and
    the largest angle from a direction of the field of view, one a cell, to the nearest ray, degrees."""
    cells = SphereCells(cell_deg)
    touched, first = np.unique(cells.of(pattern), return_index=True)
    directions, found = pattern.directions_s[torch.from_numpy(first)], []
    for start_s in np.linspace(0.0, pattern.duration_s, WINDOWS, endpoint=False):
        phase = round(start_s * pattern.points_per_second / selection.phase_step) * selection.phase_step
        frame = torch.arange(max(1, round(seconds / period_s)))
        begin = pattern.first_rows((frame + 1).double() * period_s, period_s, phase)
        rows = begin[:, None] + selection.offsets[selection.variants(begin, frame)]
        rays = _take(pattern, (rows % pattern.num_rows).unique())
        gap = largest_gap_deg(directions, rays.directions_s)
        found.append((len(np.unique(cells.of(rays))) / len(touched), gap))
    return np.mean(found, axis=0)


def largest_gap_deg(directions, rays):
    """Largest angle from any of the unit directions (D, 3) to the nearest of the unit rays (R, 3), degrees."""
    nearest = [(chunk @ rays.T).amax(dim=1) for chunk in directions.float().split(max(1, (1 << 24) // len(rays)))]
    return math.degrees(math.acos(float(torch.cat(nearest).min().clamp(-1.0, 1.0))))


def _take(pattern, rows):
    """The rows as a pattern of their own."""
    return ScanPattern(
        pattern.directions_s[rows], pattern.elevation[rows], pattern.azimuth[rows], pattern.points_per_second
    )
