"""Which rays of a real Mid-360 return nothing, by the range, slant and elevation of what their neighbours see.

    python -m benchmarks.mid360_misses files=first.pcd,second.pcd

Each file is one whole frame in order of measurement, misses kept as zeros. The mechanism that is fitted to the frame
says where a ray without a return looked. What it would have hit is taken from the returns around it: at least five
within 2.5 degrees. A ray without them looked at nothing known and is counted apart. Strays are returns nearer than
0.3 m among neighbours beyond 0.6 m, which is what the paper's mask makes of a tenth of the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks import mid360_fit
from benchmarks.harness.table import Table, about, report
from omniperception.cli import Command, argument
from omniperception.config import ConfigError
from omniperception.lidar import DEVICES, read_points
from omniperception.lidar.patterns.mid360_series import LASERS, POINTS_PER_SECOND, Mid360Motion, directions

AROUND_DEG, NEIGHBOURS, LEAST = 2.5, 9, 5
"""Neighbours of a ray: within this angle, so many at most, and at least."""
SMOOTH = 0.1
"""Neighbours whose ranges differ by less than this share of their median are one surface."""
RANGES = (0.0, 0.25, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 4.5)
INCIDENCES_DEG = (0.0, 20.0, 40.0, 60.0, 80.0)
ELEVATIONS_DEG = (-8.0, -2.0, 8.0, 18.0, 28.0, 38.0, 47.0, 54.0)
STRAY, BEHIND = 0.3, 0.6


@dataclass(frozen=True)
class Rays:
    """Every ray of a frame, with or without a return.

    Attributes:
        seen: Whether it has a return, (P,).
        ranges: m, 0 for a miss, (P,).
        row: Place in the order of measurement, (P,).
        elevation_deg: As the fitted mechanism has it, (P,).
        around_m: Median range of the neighbours, NaN where too few are known, (P,).
        smooth: Whether the neighbours are one surface, (P,).
        incidence_deg: Of the plane through them, NaN where they are not smooth, (P,).
    """

    seen: np.ndarray
    ranges: np.ndarray
    row: np.ndarray
    elevation_deg: np.ndarray
    around_m: np.ndarray
    smooth: np.ndarray
    incidence_deg: np.ndarray


def rays_of(path: Path) -> Rays:
    """Reads a frame, fits the mechanism to it and looks around each ray."""
    shots = mid360_fit.read_shots(path)
    return look_around(read_points(path).xyz, shots.lost, mid360_fit.measured(shots))


def look_around(xyz: np.ndarray, lost: tuple[int, ...], motion: Mid360Motion) -> Rays:
    """What surrounds each ray.

    Args:
        xyz: Metres, (P, 3), zero for a miss.
        lost: Places at which the file lacks a point.
        motion: The mechanism, which looks along each row.
    """
    ranges = np.linalg.norm(xyz, axis=1)
    seen = ranges > 0.0
    row = np.arange(len(xyz)) + np.searchsorted(np.array(lost, int), np.arange(len(xyz)), side="right")
    time_s = row // len(LASERS) * len(LASERS) / POINTS_PER_SECOND
    turn = 2.0 * math.pi * motion.turns_per_second * time_s + motion.turn_start
    sweep = 2.0 * math.pi * motion.sweeps_per_second * time_s + motion.sweep_start
    elevation, azimuth = directions(motion, turn, sweep, np.array(LASERS)[row % len(LASERS)])
    flat = np.cos(elevation)
    unit = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    neighbours = _neighbours(unit, np.flatnonzero(seen))
    near = np.where(neighbours >= 0, ranges[neighbours], np.nan)
    known = np.isfinite(near).sum(axis=1) >= LEAST
    around, spread = np.full(len(xyz), np.nan), np.full(len(xyz), np.inf)
    around[known] = np.nanmedian(near[known], axis=1)
    spread[known] = np.nanmax(near[known], axis=1) - np.nanmin(near[known], axis=1)
    smooth = spread < SMOOTH * around
    return Rays(seen, ranges, row, np.degrees(elevation), around, smooth, _incidence(xyz, unit, neighbours, smooth))


def _neighbours(unit: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The nearest returns around each ray other than itself, (P, 9), -1 where there are fewer."""
    targets, limit = unit[seen].astype(np.float32).T, math.cos(math.radians(AROUND_DEG))
    found = np.full((len(unit), NEIGHBOURS), -1)
    for start in range(0, len(unit), 500):
        rows = np.arange(start, min(start + 500, len(unit)))
        cosine = unit[rows].astype(np.float32) @ targets
        best = np.argpartition(-cosine, NEIGHBOURS, axis=1)[:, : NEIGHBOURS + 1]
        near = np.take_along_axis(cosine, best, axis=1)
        near[seen[best] == rows[:, None]] = -1.0
        order = np.argsort(-near, axis=1)[:, :NEIGHBOURS]
        kept = np.take_along_axis(near, order, axis=1) > limit
        found[rows] = np.where(kept, seen[np.take_along_axis(best, order, axis=1)], -1)
    return found


def _incidence(xyz: np.ndarray, unit: np.ndarray, neighbours: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    angle = np.full(len(xyz), np.nan)
    for k in np.flatnonzero(smooth):
        points = xyz[neighbours[k][neighbours[k] >= 0]]
        normal = np.linalg.eigh(np.cov((points - points.mean(axis=0)).T))[1][:, 0]
        angle[k] = math.degrees(math.acos(min(abs(float(normal @ unit[k])), 1.0)))
    return angle


def by_range(rays: Rays) -> list[dict]:
    """Misses among rays at one surface, for each range; how many of their laser's last but one were misses, too."""
    parity = (rays.row // len(LASERS) + rays.row % len(LASERS)) % 2
    after = np.zeros((2, len(rays.seen)), int)  # of the laser's shot before, and the one before that: 1 seen, -1 missed
    place = np.full(int(rays.row.max()) + 1, 0)
    place[rays.row] = np.where(rays.seen, 1, -1)
    for back in (1, 2):
        earlier = rays.row - back * len(LASERS)
        after[back - 1] = np.where(earlier >= 0, place[earlier], 0)
    rows = []
    for low, high in pairwise(RANGES):
        k = rays.smooth & (rays.around_m >= low) & (rays.around_m < high)
        lost = k & ~rays.seen
        if k.sum() < 50:
            continue
        rows.append(
            {
                "range from, m": low,
                "rays": int(k.sum()),
                "misses, %": _percent(~rays.seen, k),
                "among even / odd, %": f"{_percent(~rays.seen, k & (parity == 0)):.0f} / "
                f"{_percent(~rays.seen, k & (parity == 1)):.0f}",
                "of misses: laser's shot before missed, %": _percent(after[0] < 0, lost & (after[0] != 0)),
                "shot before that missed, %": _percent(after[1] < 0, lost & (after[1] != 0)),
            }
        )
    return rows


def by_angle(rays: Rays) -> list[dict]:
    """Misses among rays at one surface by incidence and by elevation, near and far, where at least 50 rays are."""
    rows = []
    for name, values, edges in (
        ("incidence", rays.incidence_deg, INCIDENCES_DEG),
        ("elevation", rays.elevation_deg, ELEVATIONS_DEG),
    ):
        for low, high in pairwise(edges):
            row: dict[str, object] = {"of": name, "from, deg": low, "to": high}
            for near, far in ((0.5, 0.7), (0.7, 1.5), (1.5, 4.5)):
                k = rays.smooth & (values >= low) & (values < high) & (rays.around_m >= near) & (rays.around_m < far)
                row[f"{near:g} to {far:g} m: misses, %"] = _percent(~rays.seen, k) if k.sum() >= 50 else None
                row[f"rays, {near:g} to {far:g} m"] = int(k.sum())
            rows.append(row)
    return rows


def totals(rays: Rays) -> list[dict]:
    """Where the misses of a frame are, and how many returns are strays; beside the preset's noise models."""
    known = np.isfinite(rays.around_m)
    lost = ~rays.seen
    stray = rays.seen & (rays.ranges < STRAY) & (rays.around_m > BEHIND)
    parts = {"before one surface": rays.smooth, "at edges": known & ~rays.smooth, "where nothing near returned": ~known}
    rows: list[dict] = [{"figure": "misses, % of rays", "value": _percent(lost, lost | rays.seen)}]
    rows += [{"figure": f"of these {name}, %", "value": _percent(k, lost)} for name, k in parts.items()]
    rows += [
        {"figure": "strays, % of returns", "value": _percent(stray, rays.seen)},
        {"figure": "nearest return, m", "value": float(rays.ranges[rays.seen].min())},
        {"figure": "misses of the noise model at these ranges, %", "value": modelled(rays)},
    ]
    return rows


def modelled(rays: Rays) -> float:
    """Mean dropout of the shipped model over the rays of one surface, %; compare with their misses."""
    (table,) = DEVICES["mid360"].measured
    return 100.0 * float(np.mean([table.dropout_at(r) for r in rays.around_m[rays.smooth]]))


def _percent(what: np.ndarray, among: np.ndarray) -> float:
    return 100.0 * float(what[among].mean()) if among.any() else math.nan


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    files: tuple[str, ...] = argument(doc="whole frames in order of measurement, misses kept as zeros")
    out: Path = argument(Path("outputs/mid360_misses"), "folder of the results")


def main(given: Arguments) -> None:
    """Prints and writes the tables."""
    tables = []
    for name in given.files:
        rays = rays_of(Path(name))
        if rays.seen.all():
            raise ConfigError(f"files={name} has no misses; a file that keeps them as zeros is needed")
        stem = Path(name).stem
        tables += [
            Table.of(f"{stem}_misses", f"{stem}: misses", totals(rays)),
            Table.of(f"{stem}_range", f"{stem}: misses before one surface, by range", by_range(rays)),
            Table.of(f"{stem}_angle", f"{stem}: the same by incidence and elevation", by_angle(rays)),
        ]
    report(tables, about(1), given.out)


command = Command(main, Arguments, __doc__, errors=(ValueError, FileNotFoundError, ImportError))

if __name__ == "__main__":
    command()
