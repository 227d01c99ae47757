"""A user's own scan table, from a file."""

import math
from pathlib import Path
from typing import Literal

import numpy as np

from .table import ScanPattern


def custom(
    path: str | Path,
    points_per_second: float,
    unit: Literal["deg", "rad"] = "rad",
    num_lasers: int = 1,
    rows_per_shot: int = 1,
) -> ScanPattern:
    """A pattern from a file of two columns, azimuth (from x towards y) and elevation (above xy); one row per point.

    Args:
        path: .npy, or .csv with or without a header line, of names; relative to the working directory.
        points_per_second: Rows are this far apart in time, and the table repeats.
        unit: Of both columns.
        num_lasers: Lasers that fire in turn.
        rows_per_shot: Consecutive rows that fire at one instant.
    """
    if unit not in ("deg", "rad"):
        raise ValueError(f"lidar.pattern.unit={unit!r} must be deg or rad")
    angles = _read(Path(path))
    if angles.ndim != 2 or angles.shape[1] != 2 or not len(angles):
        raise ValueError(
            f"lidar.pattern.path={path} holds {angles.shape}, expected (M, 2): azimuth and elevation in each row"
        )
    bad = np.flatnonzero(~np.isfinite(angles).all(axis=1))
    if len(bad):
        raise ValueError(f"lidar.pattern.path={path}: row {bad[0]} is {angles[bad[0]].tolist()}, expected two numbers")
    if unit == "deg":
        angles = np.radians(angles)
    steepest = np.abs(angles[:, 1]).max()
    if steepest > math.pi / 2.0 + 1e-6:
        given = math.degrees(steepest) if unit == "deg" else steepest
        raise ValueError(
            f"lidar.pattern.path={path}: an elevation of {given:g} {unit} is beyond a right angle; "
            f"the columns are azimuth, elevation, and lidar.pattern.unit={unit} may have to be "
            f"{'rad' if unit == 'deg' else 'deg'}"
        )
    return ScanPattern.from_angles(
        angles[:, 1], angles[:, 0], points_per_second, num_lasers, rows_per_shot=rows_per_shot
    )


def _read(path: Path) -> np.ndarray:
    if not path.is_file():
        raise ValueError(
            f"lidar.pattern.path={path} does not exist (working directory: {Path.cwd()}); give a .npy or .csv file"
        )
    try:
        if path.suffix == ".npy":
            return np.asarray(np.load(path), dtype=np.float64)
        if path.suffix == ".csv":
            with path.open(encoding="utf-8-sig") as file:
                lines = file.readlines()
            if not lines:
                raise ValueError("it is empty")
            has_header = _has_header(lines)
            names = [cell.strip().lower() for cell in lines[0].split(",")] if has_header else []
            if names[:1] and (names[0].startswith("elev") or (names[1:2] and names[1].startswith("azim"))):
                raise ValueError(f"its columns are {', '.join(names[:2])}; azimuth, elevation were expected")
            return np.genfromtxt(lines[has_header:], delimiter=",", dtype=np.float64, ndmin=2)
    except (ValueError, EOFError) as error:
        raise ValueError(f"lidar.pattern.path={path} cannot be read as numbers: {str(error).splitlines()[0]}") from None
    raise ValueError(f"lidar.pattern.path={path} must end in .npy or .csv")


def _has_header(lines: list[str]) -> bool:
    """Whether the first line's cells all are words, and none says that a number is missing."""
    cells = [cell.strip().lower() for cell in lines[0].split(",")]
    return all(cell[:1].isalpha() and cell not in ("nan", "inf", "infinity") for cell in cells)
