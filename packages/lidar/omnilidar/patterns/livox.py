"""Livox's non-repetitive scanners, in closed form or from the manufacturer's scan tables.

The closed forms need no data. All but the Mid-360's, a series, are a fan of lasers through two or three spinning wedge
prisms. How they were found: the spectrum of azimuth + i elevation of the scan table has lines at m f1 + n f2 only,
which gives the speeds; Snell's law was then fitted to the table by least squares for every order and orientation of
the wedges. One fits: the speeds turn out as whole rpm, and the model agrees with the table to its rounding (0.001 deg).
For the HAP, whose rows are not evenly spaced in time, the rotor's angle was a free unknown of each row, and the angles
found show when each laser fires. Each closed form is 4 s long, as the tables are; then it repeats, with a jump, as they
do.
"""

from collections.abc import Callable
from functools import cache
from importlib.resources import files
from typing import Literal

import numpy as np

from .mid360_series import MEASURED, mid360_model
from .risley import RisleyScanner, Wedge
from .table import ScanPattern

Source = Literal["model", "table"]
SECONDS = 4

MID40 = RisleyScanner((Wedge(1.5089, 18.0, 7294.0, 180.0, True), Wedge(1.5089, 18.0, -4664.0, 0.0, False)))
MID70 = RisleyScanner((Wedge(1.8144, 18.0, 7294.0, 180.0, False), Wedge(1.8144, 18.0, -4664.0, 0.0, True)))
AVIA = RisleyScanner(
    (Wedge(1.8144, 18.0, 7893.0, 180.0, False), Wedge(1.8144, 18.0, -2448.0, 0.0, True)), num_lasers=6, fan_deg=0.89726
)
TELE15 = RisleyScanner(
    (Wedge(1.5089, 7.1, 9837.0, 180.0, False), Wedge(1.5089, 7.1, -3087.0, 0.0, True)), num_lasers=6, fan_deg=0.3168
)
HORIZON = RisleyScanner(
    (
        Wedge(1.6106, 20.0, -7352.0, 180.0, False),
        Wedge(1.6106, 20.0, 7352.0, 0.0, True),
        Wedge(1.5799, 17.5, -619.0, 180.0, False),
    ),
    num_lasers=6,
    fan_deg=0.89726,
)
HAP = RisleyScanner(
    (
        Wedge(1.6052, 8.3, -617.0, 180.0, False),
        Wedge(1.6052, 22.8, 7722.0, 0.0, False),
        Wedge(1.8176, 22.6, -7722.0, 180.0, True),
    ),
    num_lasers=6,
    fan_deg=0.89726,
)

_mid360_model = cache(mid360_model)
"""Computed once in a process: it takes as long as the rest of a small environment, 0.45 of 0.88 s."""
HAP_POINTS_PER_SECOND = 452_000.0
HAP_OUTER_HZ, HAP_INNER_HZ = 424_998.0, 550_002.0
"""Shots per second of the two clocks that fire the HAP's six lasers in turn."""
HAP_INNER_DEG = np.array([20.0, 6.0])
"""Azimuth and elevation within which the faster clock fires the HAP's lasers."""
HAP_OVERLAP_DEG = 0.05
"""Margin around the inner field in which both clocks fire."""


def mid360(source: Source = "model") -> ScanPattern:
    """The scan of a Livox Mid-360: 360 x (-7.2..52.2) deg, 200,000 points/s, repeating after 4 s.

    Args:
        source: "model" is a closed form within 0.08 deg of the manufacturer's table and needs no data;
            "table" is that table, from the package of the extra ``tables``. So for all Livox scanners.
    """
    return _pattern(source, "mid360", _mid360_model, 200_000.0, 4, rows_per_shot=4)


def mid360_measured() -> ScanPattern:
    """The scan of one Livox Mid-360 as its returns show it (docs/lab/fidelity.md), 4 s of it.

    Against the maker's table it turns the other way, sweeps nearly as a sine, and both are 1 to 2 % slower.
    """
    return mid360_model(MEASURED)


def mid40(source: Source = "model") -> ScanPattern:
    """The scan of a Livox Mid-40: a rosette of 38.4 deg, 100,000 points/s, one laser."""
    return _pattern(source, "mid40", lambda: _scan(MID40, 100_000, 1), 100_000.0)


def mid70(source: Source = "model") -> ScanPattern:
    """The scan of a Livox Mid-70: a rosette of 70.4 deg, 100,000 points/s, one laser."""
    return _pattern(source, "mid70", lambda: _scan(MID70, 100_000, 1), 100_000.0)


def avia(source: Source = "model") -> ScanPattern:
    """The non-repetitive scan of a Livox Avia: 70.4 x 77.2 deg, 240,000 points/s, six lasers at once."""
    return _pattern(source, "avia", lambda: _scan(AVIA, 240_000, 0), 240_000.0, 6, rows_per_shot=6)


def tele15(source: Source = "model") -> ScanPattern:
    """The scan of a Livox Tele-15: 14.5 x 16.2 deg, 240,000 points/s, six lasers at once."""
    return _pattern(source, "tele", lambda: _scan(TELE15, 240_000, 1), 240_000.0, 6, rows_per_shot=6)


def horizon(source: Source = "model") -> ScanPattern:
    """The scan of a Livox Horizon: 81.9 x 28.2 deg, 240,000 points/s, six lasers at once.

    The datasheet says 81.7 x 25.1 deg; the manufacturer's scan table is 28.2 deg high.
    """
    return _pattern(source, "horizon", lambda: _scan(HORIZON, 240_000, 1), 240_000.0, 6, rows_per_shot=6)


def hap(source: Source = "model") -> ScanPattern:
    """The scan of a Livox HAP: 120 x 25 deg, 452,000 points/s, six lasers in turn.

    Within 20 x 6 deg of the centre the lasers fire 1.29 times as often, from a clock of their own. Rows are in order
    of time, but row i's time, i / 452,000 s, is up to 0.3 ms from when it fired. The manufacturer's table was cut off
    at a spreadsheet's 1,048,575 rows, after 2.32 s; the model goes on to 4 s. Its clocks together make 453,100 points/s
    where the manual says 452,000: the model's rotors are 0.24 % slow.
    """
    return _pattern(source, "HAP", _hap_model, HAP_POINTS_PER_SECOND, 6)


LIVOX: dict[str, Callable[[Source], ScanPattern]] = {
    make.__name__: make for make in (mid360, avia, hap, horizon, mid40, mid70, tele15)
}
"""Every Livox scanner by name."""


def _pattern(
    source: Source,
    table: str,
    model: Callable[[], ScanPattern],
    points_per_second: float,
    num_lasers: int = 1,
    rows_per_shot: int = 1,
) -> ScanPattern:
    if source == "model":
        return model()
    if source != "table":
        raise ValueError(f"lidar.pattern.source={source!r} must be 'model' or 'table'")
    angles = _read_table(table)
    return ScanPattern.from_angles(
        angles[:, 1], angles[:, 0], points_per_second, num_lasers, rows_per_shot=rows_per_shot
    )


def _read_table(name: str) -> np.ndarray:
    """Azimuth and elevation, rad, (M, 2) float32."""
    try:
        with (files("mujoco_lidar") / "scan_mode" / f"{name}.npy").open("rb") as file:
            return np.load(file)
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise ModuleNotFoundError(
            f"scan table {name!r} is not installed: pip install 'omnilidar[tables]', or use source='model'"
        ) from error


def _scan(scanner: RisleyScanner, points_per_second: int, first_shot: int) -> ScanPattern:
    """All lasers at once, shot after shot; the table begins with shot number ``first_shot``."""
    lasers = scanner.num_lasers
    shots = first_shot + np.arange(SECONDS * points_per_second // lasers)
    directions = scanner.directions(shots[:, None] * lasers / points_per_second, np.arange(lasers))
    return ScanPattern.from_directions(
        directions.reshape(-1, 3), float(points_per_second), lasers, rows_per_shot=lasers
    )


def _hap_model() -> ScanPattern:
    rows = int(SECONDS * HAP_POINTS_PER_SECOND)
    outer_time, outer = _hap_shots(HAP_OUTER_HZ)
    inner_time, inner = _hap_shots(HAP_INNER_HZ)
    outside = ~_within(outer, HAP_INNER_DEG)
    inside = _within(inner, HAP_INNER_DEG + HAP_OVERLAP_DEG)
    time = np.concatenate([outer_time[outside], inner_time[inside]])
    order = np.argsort(time, kind="stable")[:rows]
    directions = np.concatenate([outer[outside], inner[inside]])[order]
    return ScanPattern.from_directions(directions, HAP_POINTS_PER_SECOND, HAP.num_lasers)


def _hap_shots(shots_per_second: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and directions of a clock that fires the lasers in turn for ``SECONDS``."""
    shots = np.arange(int(SECONDS * shots_per_second))
    time = (shots + 1) / shots_per_second
    return time, HAP.directions(time, shots % HAP.num_lasers)


def _within(directions: np.ndarray, half_deg: np.ndarray) -> np.ndarray:
    x, y, z = directions.T
    azimuth, elevation = np.arctan2(y, x), np.arcsin(z)
    half_azimuth, half_elevation = np.radians(half_deg)
    return (np.abs(azimuth) < half_azimuth) & (np.abs(elevation) < half_elevation)
