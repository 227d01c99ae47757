"""Unitree's L1 and L2: one laser that a mirror sweeps over the zenith, from horizon to horizon, on a turning base.

The geometry is that of Unitree's SDKs (unilidar_sdk and unilidar_sdk2, functions that make points of packets), without
each unit's calibration: the tilt of the mirror's axis and the beam's distance from the axes, which the packets carry.
The mirror measures during one half of its turn. Rows are spread evenly over the whole turn, so a row's time is up to
half a turn of the mirror (2.8 ms) from when it was measured; its azimuth is that of the true time.
"""

import math

import numpy as np

from .table import ScanPattern


def unitree_l1() -> ScanPattern:
    """Unitree L1: 360 x 90 deg, 21,600 points/s: 180 sweeps per second of 120 points, 11 turns; repeats after 1 s."""
    return _swept(sweeps_per_second=180.0, points_per_sweep=120, turns_per_second=11.0, seconds=1)


def unitree_l2() -> ScanPattern:
    """Unitree L2 in its standard field of view: 360 x 90 deg, 63,936 points/s, 216 sweeps and 5.55 turns per second."""
    return _swept(sweeps_per_second=216.0, points_per_sweep=296, turns_per_second=5.55, seconds=20)


def _swept(sweeps_per_second: float, points_per_sweep: int, turns_per_second: float, seconds: int) -> ScanPattern:
    point, sweep = np.arange(points_per_sweep), np.arange(round(sweeps_per_second * seconds))
    over = math.pi * point / points_per_sweep  # from the horizon at the left, over the zenith, to that at the right
    time = (sweep[:, None] + 0.5 * point / points_per_sweep) / sweeps_per_second
    turn = 2.0 * math.pi * turns_per_second * time
    up = np.broadcast_to(np.sin(over), turn.shape)
    directions = np.stack([-np.sin(turn) * np.cos(over), np.cos(turn) * np.cos(over), up], axis=-1)
    return ScanPattern.from_directions(directions.reshape(-1, 3), sweeps_per_second * points_per_sweep)
