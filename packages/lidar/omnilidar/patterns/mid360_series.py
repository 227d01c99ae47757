"""The Livox Mid-360's scan in closed form.

Four lasers, p = 3, 1, -1, -3, fire at each mirror position. Their common centre turns while its elevation sweeps up and
down about ten times a second, and the row of four turns about that centre once per revolution. Elevation and azimuth
are sums of terms a p^power cos(or sin)(k turn + n sweep) in the mirror's turn and the sweep, fitted by least squares to
the 800,000 rows of the manufacturer's scan table (4.0 s at 200,000 points/s); terms that move no ray by more than 0.005
deg are left out. Mean angle to the table 0.011 deg, largest 0.08 deg.

``MEASURED`` is the same mechanism as one device showed it: see there.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .table import ScanPattern

POINTS_PER_SECOND = 200_000.0
ROWS = 800_000
LASERS = (3.0, 1.0, -1.0, -3.0)

Terms = Mapping[tuple[int, int], Mapping[int, float]]
"""Amplitudes in degrees: {(power, k): {n: amplitude}}."""

# fmt: off
ELEVATION_COS: Terms = {
    (1, 1): {-6: 0.0052, -5: 0.0069, -4: 0.0354, -3: 0.0254, -2: 0.1803, -1: 0.0525, 0: 0.9215, 1: 0.0844, 2: 0.0389,
             3: 0.0155, 4: 0.0084, 5: 0.0031},
    (2, 0): {0: 0.0016, 1: 0.007, 2: 0.002, 3: 0.0017},
    (2, 2): {-3: 0.0022, -1: 0.0027, 0: 0.0022, 1: 0.0014},
}
ELEVATION_SIN: Terms = {(0, 0): {1: 0.0746, 3: -0.0335}}
AZIMUTH_COS: Terms = {(0, 0): {2: -0.0072, 3: 0.0276}}
AZIMUTH_SIN: Terms = {
    (1, 1): {-8: -0.0026, -7: -0.0049, -6: -0.0119, -5: -0.0185, -4: -0.0556, -3: -0.0487, -2: -0.2158, -1: -0.003,
             0: 1.0489, 1: 0.1939, 2: 0.0907, 3: 0.0429, 4: 0.0245, 5: 0.0104, 6: 0.0053, 7: 0.0024},
    (2, 0): {1: 0.0114, 2: 0.005, 3: 0.0039, 4: 0.0021, 5: 0.0013},
    (2, 2): {-5: -0.0011, -3: -0.0021, -1: 0.0054, 0: 0.0054, 1: 0.0039, 2: 0.0019, 3: 0.0013},
}
# fmt: on


@dataclass(frozen=True)
class Mid360Motion:
    """How fast the rotors turn and where the centre of the four lasers goes.

    Attributes:
        turns_per_second: Of the mirror.
        sweeps_per_second: Of the elevation, up and down.
        elevation_cos: Amplitudes of the centre's elevation, cos(n sweep), degrees.
        azimuth_sin: Amplitudes of the centre's azimuth, sin(n sweep), degrees.
        turn_start, sweep_start: Phases at time 0, rad.
        azimuth_start_deg: Azimuth of turn 0.
        sense: -1 if the azimuth falls, as in the maker's table; 1 if it grows, the mirror image of that.
    """

    turns_per_second: float
    sweeps_per_second: float
    elevation_cos: Mapping[int, float]
    azimuth_sin: Mapping[int, float]
    turn_start: float = 0.0
    sweep_start: float = 0.0
    azimuth_start_deg: float = 0.0
    sense: float = 1.0


TABLE = Mid360Motion(
    turns_per_second=182.0 + 5.0 / 12.0,
    sweeps_per_second=10.0,
    elevation_cos={0: 20.4457, 1: 23.4897, 2: 1.1148, 3: 2.2918, 4: 0.2233, 5: 0.1564, 6: 0.033, 7: 0.0166},
    azimuth_sin={1: 28.3719, 2: 2.3231, 3: 2.6725, 4: 0.5249, 5: 0.2975, 6: 0.094, 7: 0.0454, 8: 0.017, 9: 0.0078},
    turn_start=0.011,
    sweep_start=-0.0085,
    azimuth_start_deg=269.351 + math.degrees(0.011),
    sense=-1.0,
)


MEASURED = Mid360Motion(
    turns_per_second=181.033,
    sweeps_per_second=9.845,
    elevation_cos={0: 20.85, 1: 25.76, 2: 1.17, 3: 0.32, 4: 0.05},
    azimuth_sin={1: 26.89, 2: 2.47, 3: 0.835, 4: 0.212},
)
"""One device: means of the fits to two frames of 0.1 s (docs/lab/fidelity.md), without the errors of its assembly."""


def mid360_model(motion: Mid360Motion = TABLE) -> ScanPattern:
    """4 s of the scan."""
    time = np.arange(0, ROWS, len(LASERS)) / POINTS_PER_SECOND
    turn = 2.0 * math.pi * motion.turns_per_second * time + motion.turn_start
    sweep = 2.0 * math.pi * motion.sweeps_per_second * time + motion.sweep_start
    lasers = len(LASERS)
    elevation, azimuth = directions(motion, turn[:, None], sweep[:, None], np.array(LASERS))
    return ScanPattern.from_angles(elevation.ravel(), azimuth.ravel(), POINTS_PER_SECOND, lasers, rows_per_shot=lasers)


def directions(
    motion: Mid360Motion, turn: np.ndarray, sweep: np.ndarray, laser: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth, rad, for phases in rad and lasers p; any shapes that broadcast."""
    elevation_cos = {(0, 0): motion.elevation_cos, **ELEVATION_COS}
    azimuth_sin = {(0, 0): motion.azimuth_sin, **AZIMUTH_SIN}
    elevation = _sum(elevation_cos, turn, sweep, laser).real + _sum(ELEVATION_SIN, turn, sweep, laser).imag
    aside = _sum(AZIMUTH_COS, turn, sweep, laser).real + _sum(azimuth_sin, turn, sweep, laser).imag
    return elevation, math.radians(motion.azimuth_start_deg) + motion.sense * (turn - aside)


def _sum(terms: Terms, turn: np.ndarray, sweep: np.ndarray, laser: np.ndarray) -> np.ndarray:
    """Series with cosines as real and sines as imaginary part, rad."""
    total = np.zeros(np.broadcast_shapes(turn.shape, sweep.shape, laser.shape), complex)
    for (power, k), amplitudes in terms.items():
        series = sum(a * np.exp(1j * (k * turn + n * sweep)) for n, a in amplitudes.items())
        total += np.radians(1.0) * series * laser**power
    return total
