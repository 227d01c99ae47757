"""The Mid-360's closed form against real frames: fitted to one, it predicts the other.

    python -m benchmarks.mid360_fit files=first.pcd,second.pcd

Each file is one whole frame in order of measurement, misses kept as zeros. Where in its turn and in its sweep the
device was when a frame began is not known: these phases are fitted to every frame, the rest only where it says so.
Angles are between measured and predicted directions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.harness.table import Table, about, report
from omniperception.cli import Command, argument
from omniperception.lidar import read_points
from omniperception.lidar.patterns.mid360_series import (
    LASERS,
    MEASURED,
    POINTS_PER_SECOND,
    TABLE,
    Mid360Motion,
    directions,
)

NEAREST = 0.3
"""Nearer points are rounded too coarsely, in files of whole millimetres, to give a direction, metres."""
ON_A_ROW_DEG = 0.9
"""The four points of one shot deviate less than this from even steps on a line."""
OUTLIER_DEG = 2.0
UNSURE = 12
"""Points before a place where one is found to be missing whose laser is not sure."""
HARMONICS = 4
FIT_EVERY, COARSE_EVERY = 7, 41
"""Of the returns, those that are fitted, and those by which phases are looked for; prime to the four lasers."""


@dataclass(frozen=True)
class Shots:
    """Directions of the returns of a frame.

    Attributes:
        azimuth, elevation: rad, (P,).
        time_s: Since the frame began, (P,).
        laser: The laser's p, (P,).
        lost: Places in the file at which a point is missing.
    """

    azimuth: np.ndarray
    elevation: np.ndarray
    time_s: np.ndarray
    laser: np.ndarray
    lost: tuple[int, ...]

    def every(self, step: int) -> Shots:
        """Fewer of them."""
        return Shots(*(getattr(self, name)[::step] for name in ("azimuth", "elevation", "time_s", "laser")), self.lost)


def read_shots(path: Path, nearest: float = NEAREST) -> Shots:
    """Returns of a frame, each with its laser and time; single points that the file lacks are found and counted in."""
    xyz = read_points(path).xyz
    ranges = np.linalg.norm(xyz, axis=1)
    seen = ranges > nearest
    unit = xyz / np.maximum(ranges, 1e-9)[:, None]
    shift, lost = _lost_points(unit, seen)
    row = np.arange(len(unit)) + shift
    for place in lost:
        seen[max(place - UNSURE, 0) : place] = False
    unit, row = unit[seen], row[seen]
    lasers = np.array(LASERS)
    return Shots(
        np.arctan2(unit[:, 1], unit[:, 0]),
        np.arcsin(np.clip(unit[:, 2], -1.0, 1.0)),
        row // len(lasers) * len(lasers) / POINTS_PER_SECOND,
        lasers[row % len(lasers)],
        lost,
    )


def _lost_points(unit: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """How many points are missing before each, (P,), and where: four stand in line only in the right grouping."""
    four = seen[:-3] & seen[1:-2] & seen[2:-1] & seen[3:]
    bends = np.linalg.norm(unit[:-2] - 2.0 * unit[1:-1] + unit[2:], axis=1)
    bend = np.degrees(bends[:-1] + bends[1:])
    start = np.flatnonzero(four & (bend < ON_A_ROW_DEG))
    shift, lost, at = np.zeros(len(unit), int), [], 0
    for k, (place, phase) in enumerate(zip(start, start % 4, strict=True)):
        ahead = start[k : k + 12] % 4
        if phase == (at - 1) % 4 and np.mean(ahead == phase) > 0.8:
            at = phase
            shift[place:] += 1
            lost.append(int(place))
    return shift, tuple(lost)


def angles(motion: Mid360Motion, shots: Shots) -> np.ndarray:
    """Between measured and predicted directions, degrees, (P,)."""
    return np.degrees(np.hypot(*_errors(motion, shots)))


def _errors(motion: Mid360Motion, shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Along elevation and along azimuth, rad on the sphere."""
    turn = 2.0 * math.pi * motion.turns_per_second * shots.time_s + motion.turn_start
    sweep = 2.0 * math.pi * motion.sweeps_per_second * shots.time_s + motion.sweep_start
    elevation, azimuth = directions(motion, turn, sweep, shots.laser)
    aside = np.angle(np.exp(1j * (azimuth - shots.azimuth)))
    return elevation - shots.elevation, aside * np.cos(shots.elevation)


Parameters = tuple[str, ...]
PHASES: Parameters = ("turn_start", "sweep_start")
SPEEDS: Parameters = ("turns_per_second", "sweeps_per_second")
AMPLITUDES: Parameters = (
    *(f"elevation_cos:{n}" for n in range(HARMONICS + 1)),
    *(f"azimuth_sin:{n}" for n in range(1, HARMONICS + 1)),
)
ASSEMBLY: Parameters = ("offset_along", "offset_across")
STEPS = {"turn_start": 1e-4, "sweep_start": 1e-4, "turns_per_second": 1e-3, "sweeps_per_second": 1e-3}


def _get(motion: Mid360Motion, name: str) -> float:
    field, _, n = name.partition(":")
    value = getattr(motion, field)
    return value.get(int(n), 0.0) if n else value


def _with(motion: Mid360Motion, name: str, value: float) -> Mid360Motion:
    field, _, n = name.partition(":")
    return replace(motion, **{field: {**getattr(motion, field), int(n): value} if n else value})


def fit(motion: Mid360Motion, shots: Shots, names: Parameters, rounds: int = 6) -> Mid360Motion:
    """Least squares of some parameters by Gauss-Newton, without points that are far off."""
    shots = shots.every(FIT_EVERY)
    for _ in range(rounds):
        errors = np.stack(_errors(motion, shots), axis=1)
        angle = np.degrees(np.linalg.norm(errors, axis=1))
        kept = angle < max(OUTLIER_DEG, 2.0 * float(np.median(angle)))
        columns = []
        for name in names:
            step = STEPS.get(name, 1e-3)
            changed = _errors(_with(motion, name, _get(motion, name) + step), shots)
            columns.append((np.stack(changed, axis=1) - errors)[kept].ravel() / step)
        change = np.linalg.lstsq(np.stack(columns, axis=1), -errors[kept].ravel(), rcond=None)[0]
        for name, value in zip(names, change, strict=True):
            motion = _with(motion, name, _get(motion, name) + float(value))
    return motion


def start_phases(motion: Mid360Motion, shots: Shots, steps: int = 24) -> Mid360Motion:
    """The phases at the frame's beginning: the best of a grid of sweeps with its best turn, then least squares."""
    few = shots.every(COARSE_EVERY)
    found: list[tuple[float, Mid360Motion]] = []
    for sweep in np.arange(steps) * 2.0 * math.pi / steps:
        trial = replace(motion, sweep_start=float(sweep), turn_start=0.0)
        turn = 0.0
        for _ in range(3):  # the row of lasers turns, too
            _, aside = _errors(replace(trial, turn_start=turn), few)
            off = np.angle(np.exp(1j * aside / np.cos(few.elevation)).mean())
            turn -= motion.sense * float(off)
        trial = replace(trial, turn_start=turn)
        found.append((float(np.median(angles(trial, few))), trial))
    best = min(found, key=lambda pair: pair[0])[1]
    return fit(best, shots, PHASES)


def mirrored(motion: Mid360Motion) -> Mid360Motion:
    """The mirror image, in which the row of lasers lies along x at azimuth 0 as in the frames."""
    return replace(motion, sense=-motion.sense, azimuth_start_deg=0.0)


def turned(motion: Mid360Motion, shots: Shots) -> Mid360Motion:
    """The best of a free yaw of the frame, beside the phases."""
    trials = [start_phases(replace(motion, azimuth_start_deg=yaw), shots) for yaw in range(0, 360, 45)]
    return min(trials, key=lambda trial: float(np.median(angles(trial, shots))))


def measured(shots: Shots, assembly: bool = True) -> Mid360Motion:
    """Speeds, amplitudes and phases from one frame; with the assembly, where its row of lasers sits."""
    motion = start_phases(mirrored(TABLE), shots)
    motion = fit(motion, shots, (*PHASES, *SPEEDS))
    return fit(motion, shots, (*PHASES, *SPEEDS, *AMPLITUDES, *(ASSEMBLY if assembly else ())), rounds=10)


def comparison(frames: dict[str, Shots]) -> list[dict]:
    """Each model against each frame, and what a fit to one frame says of the others."""
    rows = []
    for name, shots in frames.items():
        rows.append(_row("maker's table, frame turned at will", name, turned(TABLE, shots), shots, "phases, yaw"))
        image = start_phases(mirrored(TABLE), shots)
        rows.append(_row("mirror image of the table", name, image, shots, "phases"))
        rows.append(_row("the same", name, fit(image, shots, (*PHASES, *SPEEDS)), shots, "phases, speeds"))
        rows.append(_row("lidar=mid360_measured", name, start_phases(MEASURED, shots), shots, "phases"))
        for assembly in (False, True):
            own, more = measured(shots, assembly), ", assembly" * assembly
            rows.append(_row("the same", name, own, shots, f"phases, speeds, amplitudes{more}"))
            for other, its in frames.items():
                if other != name:
                    rows.append(_row(f"fitted to {name}{more}", other, start_phases(own, its), its, "phases"))
    return rows


def _row(model: str, frame: str, motion: Mid360Motion, shots: Shots, free: str) -> dict:
    angle = angles(motion, shots)
    return {
        "model": model,
        "frame": frame,
        "fitted to the frame": free,
        "mean, deg": float(angle.mean()),
        "median, deg": float(np.median(angle)),
        "99 %, deg": float(np.percentile(angle, 99)),
        "turns/s": motion.turns_per_second,
        "sweeps/s": motion.sweeps_per_second,
    }


def parameters(motions: Iterable[tuple[str, Mid360Motion]]) -> list[dict]:
    """Speeds and amplitudes of each fit, beside the table's."""
    return [
        {"fit": name, **{key: _get(motion, key) for key in (*SPEEDS, *AMPLITUDES, *ASSEMBLY)}}
        for name, motion in (("table", TABLE), ("mid360_measured", MEASURED), *motions)
    ]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    files: tuple[str, ...] = argument(doc="whole frames in order of measurement, misses kept as zeros")
    out: Path = argument(Path("outputs/mid360_fit"), "folder of the results")


def main(given: Arguments) -> None:
    """Prints and writes the tables."""
    frames = {Path(name).stem: read_shots(Path(name)) for name in given.files}
    notes = [f"{name}: {len(shots.time_s):,} returns, points missing at {shots.lost}" for name, shots in frames.items()]
    fits = parameters((name, measured(shots)) for name, shots in frames.items())
    tables = [
        Table.of("mid360_fit", "closed forms against real frames", comparison(frames), notes),
        Table.of("mid360_parameters", "speeds (1/s) and amplitudes (deg)", fits),
    ]
    report(tables, about(1), given.out)


command = Command(main, Arguments, __doc__, errors=(ValueError, FileNotFoundError, ImportError))

if __name__ == "__main__":
    command()
