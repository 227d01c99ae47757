"""How well the closed-form Livox scans match the makers' tables, and what each way of keeping fewer rays sees.

    python scripts/pattern_coverage.py sensors=mid360,avia num_rays=1000

Any LiDAR preset will do; only Livox scanners have tables (extra `tables`), which are left out where they are not
installed. The picture (extra `plots`) shows each pattern after 0.1, 0.5 and 1 s.

A pattern's field of view is the set of cells that its whole table touches. Counts are per cell of ``SphereCells``,
averaged over several windows of the table.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch

from benchmarks.harness.table import Table, about, report
from omniperception.cli import Command, argument
from omniperception.common.figures import PlotsUnavailable, new_figure
from omniperception.lidar import DEVICES, LIVOX
from omniperception.lidar.patterns.cells import SphereCells
from omniperception.lidar.patterns.selection import Selection, Strategy, make_selection
from omniperception.lidar.patterns.table import ScanPattern

DURATIONS_S = (0.1, 0.5, 1.0)
SLACK_ROWS = {"hap": 1000}
"""Sensors whose model fires in an order that drifts from the table's, and by how many rows at most."""
WINDOWS = 4
"""Windows of the table over which shares are averaged, evenly placed."""


@dataclass(frozen=True)
class Comparison:
    """A model against its table, over one duration.

    Attributes:
        seconds: Length of the windows.
        overlap: Histogram overlap, the sum over cells of the smaller of both shares of points: 1 for the same counts.
        seen_model: Fraction of the table's field of view that the model sees.
        seen_table: Fraction that the table sees.
    """

    seconds: float
    overlap: float
    seen_model: float
    seen_table: float


@dataclass(frozen=True)
class Coverage:
    """What a selection of rays sees, over one duration.

    Attributes:
        seconds: Length of the windows.
        seen: Fraction of the pattern's field of view with at least one ray.
        gap_deg: Largest angle from a direction of the field of view, one per cell, to the nearest ray, degrees.
    """

    seconds: float
    seen: float
    gap_deg: float


def cell_share(pattern: ScanPattern, start_s: float, seconds: float, cells: SphereCells) -> np.ndarray:
    """Share of the points of [start_s, start_s + seconds) in each cell, (num_cells,), which sums to 1."""
    rows = _window(pattern, start_s, seconds)
    counts = np.bincount(cells.of(_take(pattern, rows)), minlength=cells.num_cells)
    return counts / counts.sum()


def overlap(share: np.ndarray, other: np.ndarray) -> float:
    """Sum over cells of the smaller of two shares of points: 1 for the same, 0 for disjoint."""
    return float(np.minimum(share, other).sum())


def compare(
    model: ScanPattern, table: ScanPattern, durations_s: Iterable[float] = DURATIONS_S, cell_deg: float = 2.0
) -> list[Comparison]:
    """A closed form against the scan table that it was fitted to, for each duration."""
    cells = SphereCells(cell_deg)
    field = np.unique(cells.of(table))
    shared_s = min(model.duration_s, table.duration_s)
    rows = []
    for seconds in durations_s:
        shares = [
            (cell_share(model, start, seconds, cells), cell_share(table, start, seconds, cells))
            for start in np.linspace(0.0, max(0.0, shared_s - seconds), WINDOWS)
        ]
        rows.append(
            Comparison(
                seconds,
                float(np.mean([overlap(a, b) for a, b in shares])),
                float(np.mean([(a[field] > 0).mean() for a, _ in shares])),
                float(np.mean([(b[field] > 0).mean() for _, b in shares])),
            )
        )
    return rows


def angle_to_table(model: ScanPattern, table: ScanPattern, slack_rows: int = 0) -> tuple[float, float]:
    """Mean and largest angle from rows of the table to the model's same rows, degrees; 10,000 rows, evenly placed.

    With ``slack_rows``, to the nearest of the model's rows that are at most so many before or after: for a model whose
    order of firing drifts from the table's.
    """
    last = min(model.num_rows, table.num_rows) - 1 - slack_rows
    rows = torch.linspace(slack_rows, last, 10_000 if slack_rows == 0 else 1_000, dtype=torch.float64).round().long()
    near = rows[:, None] + torch.arange(-slack_rows, slack_rows + 1)
    gap = model.directions_s[near].double() - table.directions_s[rows, None].double()
    chord = torch.linalg.vector_norm(gap, dim=2).amin(dim=1)
    angle = torch.rad2deg(2.0 * torch.asin((chord / 2.0).clamp(max=1.0)))
    return float(angle.mean()), float(angle.max())


def selection_coverage(
    pattern: ScanPattern,
    selection: Selection,
    period_s: float,
    durations_s: Iterable[float] = DURATIONS_S,
    cell_deg: float = 2.0,
) -> list[Coverage]:
    """What the frames of a selection see in each duration, for one environment at several times."""
    cells = SphereCells(cell_deg)
    field = _field_of_view(pattern, cells)
    rows = []
    for seconds in durations_s:
        frames = max(1, round(seconds / period_s))
        starts = np.linspace(0.0, pattern.duration_s, WINDOWS, endpoint=False)
        found = [_seen(pattern, _frames(pattern, selection, period_s, s, frames), cells, field) for s in starts]
        rows.append(Coverage(seconds, *(float(np.mean(column)) for column in zip(*found, strict=True))))
    return rows


def strategy_coverage(
    pattern: ScanPattern,
    period_s: float = 0.1,
    num_rays: int = 1000,
    durations_s: Iterable[float] = DURATIONS_S,
    cell_deg: float = 2.0,
    seed: int = 0,
) -> dict[str, list[Coverage]]:
    """``selection_coverage`` of every strategy and, for comparison, of all points ("all")."""
    strategies = {s: make_selection(pattern, period_s, num_rays, s, seed) for s in get_args(Strategy)}
    strategies["all"] = make_selection(pattern, period_s, pattern.points_per_frame(period_s))
    return {
        name: selection_coverage(pattern, selection, period_s, durations_s, cell_deg)
        for name, selection in strategies.items()
    }


def largest_gap_deg(directions: torch.Tensor, rays: torch.Tensor) -> float:
    """Largest angle from any of the unit ``directions`` (D, 3) to the nearest of the unit ``rays`` (R, 3), degrees."""
    nearest = [(chunk @ rays.T).amax(dim=1) for chunk in directions.float().split(max(1, (1 << 24) // len(rays)))]
    return math.degrees(math.acos(float(torch.cat(nearest).min().clamp(-1.0, 1.0))))


def _window(pattern: ScanPattern, start_s: float, seconds: float) -> torch.Tensor:
    first = math.ceil(start_s * pattern.points_per_second - 1e-3)
    return (first + torch.arange(pattern.points_per_frame(seconds))) % pattern.num_rows


def _take(pattern: ScanPattern, rows: torch.Tensor) -> ScanPattern:
    """The rows as a pattern of their own."""
    return ScanPattern(
        pattern.directions_s[rows], pattern.elevation[rows], pattern.azimuth[rows], pattern.points_per_second
    )


def _field_of_view(pattern: ScanPattern, cells: SphereCells) -> tuple[np.ndarray, torch.Tensor]:
    """Cells that the table touches, and one of its directions in each of them, (D, 3)."""
    touched, first = np.unique(cells.of(pattern), return_index=True)
    return touched, pattern.directions_s[torch.from_numpy(first)]


def _frames(pattern: ScanPattern, selection: Selection, period_s: float, start_s: float, frames: int) -> torch.Tensor:
    """Table rows of successive frames of one environment that begins at a phase of the selection, (frames * N,)."""
    phase = round(start_s * pattern.points_per_second / selection.phase_step) * selection.phase_step
    frame = torch.arange(frames)
    first = pattern.first_rows((frame + 1).double() * period_s, period_s, phase)
    variants = selection.variants(first, frame)
    return ((first[:, None] + selection.offsets[variants]) % pattern.num_rows).ravel()


def _seen(
    pattern: ScanPattern, rows: torch.Tensor, cells: SphereCells, field: tuple[np.ndarray, torch.Tensor]
) -> tuple[float, float]:
    rays = _take(pattern, rows.unique())
    seen = len(np.unique(cells.of(rays))) / len(field[0])
    return seen, largest_gap_deg(field[1], rays.directions_s)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    sensors: tuple[str, ...] = argument(tuple(LIVOX), "sensors", choices=tuple(DEVICES))
    num_rays: int = argument(1000, "rays kept of a frame", least=1)
    period_s: float = argument(0.1, "length of a frame (s)", positive=True)
    cell_deg: float = argument(2.0, "size of a cell of the field of view (deg)", positive=True)
    out: Path = argument(Path("outputs/pattern_coverage"), "folder of the results")


def load(name: str) -> tuple[ScanPattern, ScanPattern | None]:
    """A sensor's closed form, and its table where there is one."""
    if name not in LIVOX:
        return DEVICES[name].pattern(), None
    try:
        return LIVOX[name]("model"), LIVOX[name]("table")
    except ModuleNotFoundError as error:
        print(f"{name}: {error}")
        return LIVOX[name]("model"), None


def tables(patterns: dict[str, tuple[ScanPattern, ScanPattern | None]], given: Arguments) -> list[Table]:
    """Models against their tables, and what the strategies see."""
    matches, seen, notes = [], [], []
    for name, (model, table) in patterns.items():
        for strategy, rows in strategy_coverage(model, given.period_s, given.num_rays, cell_deg=given.cell_deg).items():
            for row in rows:
                seen.append({"sensor": name, "rays kept": strategy, "s": row.seconds, "seen": row.seen})
                seen[-1]["largest gap, deg"] = row.gap_deg
        if table is not None:
            mean, largest = angle_to_table(model, table, SLACK_ROWS.get(name, 0))
            notes.append(f"{name}: angle to the table mean {mean:.4f} deg, largest {largest:.4f} deg")
            matches += [{"sensor": name, **vars(row)} for row in compare(model, table, cell_deg=given.cell_deg)]
    title = f"share of the field of view that {given.num_rays} rays every {given.period_s:g} s see"
    found = [Table.of("pattern_coverage", title, seen)]
    if matches:
        found.append(Table.of("pattern_models", "closed forms against the makers' tables", matches, notes))
    return found


def draw(patterns: dict[str, tuple[ScanPattern, ScanPattern | None]], path: Path) -> None:
    """Azimuth and elevation of each pattern's points after each duration."""
    figure = new_figure(5.0 * len(DURATIONS_S), 3.2 * len(patterns))
    axes = figure.subplots(len(patterns), len(DURATIONS_S), squeeze=False)
    for (name, (model, table)), line in zip(patterns.items(), axes, strict=True):
        for seconds, axis in zip(DURATIONS_S, line, strict=True):
            for label, pattern, colour, size in (("table", table, "orange", 1.2), ("model", model, "navy", 0.15)):
                if pattern is not None:
                    count = pattern.points_per_frame(seconds)
                    rows = slice(0, min(count, pattern.num_rows), max(1, count // 60_000))
                    azimuth = (pattern.azimuth[rows].rad2deg() + 180.0) % 360.0 - 180.0
                    elevation = pattern.elevation[rows].rad2deg()
                    axis.scatter(azimuth, elevation, s=size, c=colour, linewidths=0, label=f"{label}, {count:,} points")
            axis.set(title=f"{name}, {seconds:g} s", xlabel="azimuth, deg", ylabel="elevation, deg")
            axis.legend(loc="lower right", fontsize=6, markerscale=8)
    figure.savefig(path, dpi=110)


def main(given: Arguments) -> None:
    """Prints and writes the tables and the picture."""
    patterns = {name: load(name) for name in given.sensors}
    report(tables(patterns, given), about(1), given.out)
    draw(patterns, given.out / "patterns.png")


command = Command(main, Arguments, __doc__, errors=(PlotsUnavailable,))

if __name__ == "__main__":
    command()
