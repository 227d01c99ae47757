"""The Livox Mid-360's scan in closed form.

Four lasers, p = 3, 1, -1, -3, fire at each mirror position. Their common centre turns clockwise while its elevation
sweeps up and down ten times a second, and the row of four turns about that centre once per revolution. Elevation and
azimuth are sums of terms a p^power cos(or sin)(k turn + n sweep) in the mirror's turn and the sweep, fitted by least
squares to the 800,000 rows of the manufacturer's scan table (4.0 s at 200,000 points/s); terms that move no ray by more
than 0.005 deg are left out. Mean angle to the table 0.011 deg, largest 0.08 deg.
"""

import math
from collections.abc import Mapping

import numpy as np

from .table import ScanPattern

POINTS_PER_SECOND = 200_000.0
ROWS = 800_000
LASERS = (3.0, 1.0, -1.0, -3.0)
TURNS_PER_SECOND, TURN_START = 182.0 + 5.0 / 12.0, 0.011
SWEEPS_PER_SECOND, SWEEP_START = 10.0, -0.0085
AZIMUTH_START_DEG = 269.351

Terms = Mapping[tuple[int, int], Mapping[int, float]]
"""Amplitudes in degrees: {(power, k): {n: amplitude}}."""

# fmt: off
ELEVATION_COS: Terms = {
    (0, 0): {0: 20.4457, 1: 23.4897, 2: 1.1148, 3: 2.2918, 4: 0.2233, 5: 0.1564, 6: 0.033, 7: 0.0166},
    (1, 1): {-6: 0.0052, -5: 0.0069, -4: 0.0354, -3: 0.0254, -2: 0.1803, -1: 0.0525, 0: 0.9215, 1: 0.0844, 2: 0.0389,
             3: 0.0155, 4: 0.0084, 5: 0.0031},
    (2, 0): {0: 0.0016, 1: 0.007, 2: 0.002, 3: 0.0017},
    (2, 2): {-3: 0.0022, -1: 0.0027, 0: 0.0022, 1: 0.0014},
}
ELEVATION_SIN: Terms = {(0, 0): {1: 0.0746, 3: -0.0335}}
AZIMUTH_COS: Terms = {(0, 0): {2: -0.0072, 3: 0.0276}}
AZIMUTH_SIN: Terms = {
    (0, 0): {1: 28.3719, 2: 2.3231, 3: 2.6725, 4: 0.5249, 5: 0.2975, 6: 0.094, 7: 0.0454, 8: 0.017, 9: 0.0078},
    (1, 1): {-8: -0.0026, -7: -0.0049, -6: -0.0119, -5: -0.0185, -4: -0.0556, -3: -0.0487, -2: -0.2158, -1: -0.003,
             0: 1.0489, 1: 0.1939, 2: 0.0907, 3: 0.0429, 4: 0.0245, 5: 0.0104, 6: 0.0053, 7: 0.0024},
    (2, 0): {1: 0.0114, 2: 0.005, 3: 0.0039, 4: 0.0021, 5: 0.0013},
    (2, 2): {-5: -0.0011, -3: -0.0021, -1: 0.0054, 0: 0.0054, 1: 0.0039, 2: 0.0019, 3: 0.0013},
}
# fmt: on


def mid360_model() -> ScanPattern:
    """4 s of the scan."""
    time = np.arange(0, ROWS, len(LASERS)) / POINTS_PER_SECOND
    turned = 2.0 * math.pi * TURNS_PER_SECOND * time
    turn, sweep = turned + TURN_START, 2.0 * math.pi * SWEEPS_PER_SECOND * time + SWEEP_START
    elevation = _sum(np.cos, ELEVATION_COS, turn, sweep) + _sum(np.sin, ELEVATION_SIN, turn, sweep)
    azimuth = _sum(np.cos, AZIMUTH_COS, turn, sweep) + _sum(np.sin, AZIMUTH_SIN, turn, sweep)
    azimuth += math.radians(AZIMUTH_START_DEG) - turned[:, None]
    lasers = len(LASERS)
    return ScanPattern.from_angles(elevation.ravel(), azimuth.ravel(), POINTS_PER_SECOND, lasers, rows_per_shot=lasers)


def _sum(wave: np.ufunc, terms: Terms, turn: np.ndarray, sweep: np.ndarray) -> np.ndarray:
    """rad, for each mirror position and laser, (positions, 4)."""
    lasers = np.array(LASERS)
    total = np.zeros((len(turn), len(lasers)))
    for (power, k), amplitudes in terms.items():
        series = sum(a * wave(k * turn + n * sweep) for n, a in amplitudes.items())
        total += np.radians(series)[:, None] * lasers**power
    return total
