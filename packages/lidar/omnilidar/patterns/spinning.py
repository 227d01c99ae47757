"""Spinning sensors: a column of lasers that turns clockwise, seen from above, and fires in a fixed cycle.

A ray's azimuth follows from the time at which its laser fires: minus the turning rate times that time, minus the
laser's own offset. Rows are in order of firing, single return, and the table begins with a column at azimuth 0.
``frame_hz`` of a device is its turns per second, 5..20.
The table holds whole turns: one where a turn holds a whole number of columns; otherwise as many, up to ten, as hold
nearly so, and the turning rate is changed by that little (3e-6 for Velodyne's at 10 Hz) to close the table.
A device that pauses between cycles has its rows spread evenly over the cycle, so a row's time, i / points_per_second,
is up to one cycle (55 us) from when it fired; its azimuth is that of the true time.
"""

import math
from collections.abc import Sequence

import numpy as np

from .table import ScanPattern

MAX_TURNS = 10
MICROSECOND = 1e-6

# Velodyne VLP-16 user manual (63-9243), table of vertical angles by laser: the order in which they fire.
VLP16_ELEVATION_DEG = (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15)

# Velodyne VLP-32C user manual (63-9325), elevation and azimuth offset by laser; pairs fire together, in this order.
# fmt: off
VLP32C_ELEVATION_DEG = (
    -25.0, -1.0, -1.667, -15.639, -11.31, 0.0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667,
    -4.0, -4.667, 1.667, 1.0, -3.667, -3.333, 3.333, 2.333, -2.667, -3.0, 7.0, 4.667, -2.333, -2.0, 15.0, 10.333,
    -1.333,
)
VLP32C_OFFSET_DEG = (
    1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4,
    1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4,
)
# fmt: on

OUSTER_FOV_DEG = {"OS0": 90.0, "OS1": 45.0, "OS2": 22.5}
OUSTER_OFFSET_DEG = {"OS0": (10.98, 3.66), "OS1": (4.25, 1.42), "OS2": (2.07, 0.69)}
"""Azimuth of the outer and inner two of the four columns of beams: beam angles in the metadata of the Ouster SDK."""
OUSTER_MODES = {"512x10": (512, 10), "1024x10": (1024, 10), "2048x10": (2048, 10), "512x20": (512, 20)}
OUSTER_MODES |= {"1024x20": (1024, 20)}

# Firing times of the Airy's twelve groups of eight channels: RoboSense's driver rs_driver, decoder of the Airy.
AIRY_FIRE_US = (0.0, 7.616, 16.184, 24.752, 33.32, 42.84, 52.36, 61.88, 71.4, 79.968, 88.536, 97.104)


def spinning(
    elevation_deg: Sequence[float],
    frame_hz: float,
    cycle_s: float,
    fire_s: Sequence[float] | float = 0.0,
    offset_deg: Sequence[float] | float = 0.0,
) -> ScanPattern:
    """Any sensor whose column of lasers spins.

    Args:
        elevation_deg: Of each laser, (C,), as listed; lasers that fire together keep this order.
        frame_hz: Turns per second.
        cycle_s: Time from one column to the next; all lasers fire once in it.
        fire_s: When each laser fires within the cycle, (C,); a number: all at that time.
        offset_deg: Clockwise azimuth of each laser from the column's, (C,).
    """
    elevation, fire, offset = np.broadcast_arrays(*(np.asarray(a, float) for a in (elevation_deg, fire_s, offset_deg)))
    if elevation.ndim != 1 or elevation.size < 1 or np.abs(elevation).max() > 90.0:
        raise ValueError(f"spinning: elevation_deg={elevation_deg} must list angles within -90..90")
    for name, value in (("frame_hz", frame_hz), ("cycle_s", cycle_s)):
        if not (value > 0.0 and math.isfinite(value)):
            raise ValueError(f"spinning: {name}={value} must be positive and finite")
    if fire.min() < 0.0 or fire.max() >= cycle_s:
        raise ValueError(f"spinning: fire_s must lie within 0..cycle_s={cycle_s}")
    order = np.argsort(fire, kind="stable")
    columns_per_turn = 1.0 / (cycle_s * frame_hz)
    if columns_per_turn < 1.0 - 1e-9:
        raise ValueError(f"spinning: cycle_s={cycle_s} must be shorter than a turn at frame_hz={frame_hz}")
    turns = min(
        range(1, MAX_TURNS + 1), key=lambda n: round(abs(round(n * columns_per_turn) / n - columns_per_turn), 6)
    )
    columns = round(turns * columns_per_turn)
    turn = turns * (np.arange(columns)[:, None] + fire[order] / cycle_s) / columns
    azimuth = -2.0 * math.pi * turn - np.radians(offset[order])
    lasers = len(order)
    at_once = lasers if fire.max() == fire.min() else 1
    return ScanPattern.from_angles(
        np.tile(np.radians(elevation[order]), columns),
        azimuth.ravel(),
        lasers / cycle_s,
        lasers,
        rows_per_shot=at_once,
    )


def hdl64e(frame_hz: float = 10.0) -> ScanPattern:
    """Velodyne HDL-64E: upper 32 lasers at 1/3 deg (+2..-8.33), lower 32 at 1/2 deg (-8.83..-24.33), 1.33 M points/s.

    One cycle of all lasers takes 48 us. Laser i of both blocks fires at once, the 32 pairs evenly over the cycle. Each
    unit's own calibration, which shifts lasers by up to some degrees in azimuth, is left out.
    """
    upper, lower = 2.0 - np.arange(32) / 3.0, -8.83 - 0.5 * np.arange(32)
    cycle = 48.0 * MICROSECOND
    fire = np.repeat(np.arange(32) / 32.0 * cycle, 2)
    elevation = np.stack([upper, lower], axis=1).ravel()
    return spinning(elevation.tolist(), _spin_rate(frame_hz), cycle, fire.tolist())


def hdl32e(frame_hz: float = 10.0) -> ScanPattern:
    """Velodyne HDL-32E: 4/3 deg apart, +10.67..-30.67 deg, 694,444 points/s; from the lowest, two banks in turn."""
    lower = -92.0 / 3.0 + 4.0 / 3.0 * np.arange(16)
    upper = lower + 64.0 / 3.0
    fire = 1.152 * MICROSECOND * np.arange(32)
    elevation = np.stack([lower, upper], axis=1).ravel()
    return spinning(elevation.tolist(), _spin_rate(frame_hz), 46.08 * MICROSECOND, fire.tolist())


def vlp16(frame_hz: float = 10.0) -> ScanPattern:
    """Velodyne VLP-16: 16 lasers 2 deg apart, +-15 deg, 289,352 points/s; each fires 2.304 us after the one before."""
    fire = 2.304 * MICROSECOND * np.arange(16)
    return spinning(VLP16_ELEVATION_DEG, _spin_rate(frame_hz), 55.296 * MICROSECOND, fire.tolist())


def vlp32c(frame_hz: float = 10.0) -> ScanPattern:
    """Velodyne VLP-32C: 32 uneven lasers, -25..+15 deg, in four columns, 578,704 points/s; a pair every 2.304 us."""
    fire = 2.304 * MICROSECOND * (np.arange(32) // 2)
    rate = _spin_rate(frame_hz)
    return spinning(VLP32C_ELEVATION_DEG, rate, 55.296 * MICROSECOND, fire.tolist(), VLP32C_OFFSET_DEG)


def os0(channels: int = 128, mode: str = "1024x10") -> ScanPattern:
    """Ouster OS0, +-45 deg. Arguments as ``ouster``."""
    return ouster("OS0", channels, mode)


def os1(channels: int = 128, mode: str = "1024x10") -> ScanPattern:
    """Ouster OS1, +-22.5 deg. Arguments as ``ouster``."""
    return ouster("OS1", channels, mode)


def os2(channels: int = 128, mode: str = "1024x10") -> ScanPattern:
    """Ouster OS2, +-11.25 deg. Arguments as ``ouster``."""
    return ouster("OS2", channels, mode)


def ouster(model: str, channels: int = 128, mode: str = "1024x10") -> ScanPattern:
    """An Ouster sensor: elevation_i = FOV/2 - i FOV/(channels - 1); all channels of a column fire at once.

    The 128 beams stand in four columns, and the next beam in the next column; 64 channels are every second beam, 32
    every fourth. Each beam starts up to 3 cm from the axis, which is left out.

    Args:
        model: OS0, OS1 or OS2.
        channels: 32, 64 or 128.
        mode: Columns per turn x turns per second: 512x10, 1024x10, 2048x10, 512x20 or 1024x20.
    """
    if model not in OUSTER_FOV_DEG:
        raise ValueError(f"ouster: model={model!r} must be one of {', '.join(OUSTER_FOV_DEG)}")
    if channels not in (32, 64, 128):
        raise ValueError(f"lidar.pattern.channels={channels} must be 32, 64 or 128")
    if mode not in OUSTER_MODES:
        raise ValueError(f"lidar.pattern.mode={mode!r} must be one of {', '.join(OUSTER_MODES)}")
    fov = OUSTER_FOV_DEG[model]
    outer, inner = OUSTER_OFFSET_DEG[model]
    kept = np.arange(128)[128 // channels - 1 :: 128 // channels]
    offset = np.array([outer, inner, -inner, -outer])[kept % 4]
    columns, frame_hz = OUSTER_MODES[mode]
    elevation = np.linspace(fov / 2.0, -fov / 2.0, channels)
    return spinning(elevation.tolist(), frame_hz, 1.0 / (columns * frame_hz), offset_deg=offset.tolist())


def xt32(frame_hz: float = 10.0) -> ScanPattern:
    """Hesai XT32: 1 deg apart, +15..-16 deg, 640,000 points/s; channels fire 1.512 us apart, from the top."""
    return _hesai_xt(32, frame_hz)


def xt16(frame_hz: float = 10.0) -> ScanPattern:
    """Hesai XT16: 2 deg apart, +-15 deg, 320,000 points/s; channels fire 3.024 us apart, from the top."""
    return _hesai_xt(16, frame_hz)


def airy(frame_hz: float = 10.0) -> ScanPattern:
    """RoboSense Airy: 96 channels evenly over 0..90 deg, 864,000 points/s; groups of eight fire together."""
    fire = MICROSECOND * np.repeat(AIRY_FIRE_US, 8)
    return spinning(np.linspace(0.0, 90.0, 96).tolist(), _spin_rate(frame_hz), 1.0 / 9000.0, fire.tolist())


def _hesai_xt(channels: int, frame_hz: float) -> ScanPattern:
    step = 32 // channels
    fire = 1.512 * MICROSECOND * step * np.arange(channels)  # Hesai's SDK, firetime corrections of the PandarXT
    elevation = 15.0 - step * np.arange(channels)
    return spinning(elevation.tolist(), _spin_rate(frame_hz), 50.0 * MICROSECOND, fire.tolist())


def _spin_rate(frame_hz: float) -> float:
    if not 5.0 <= frame_hz <= 20.0:
        raise ValueError(f"lidar.pattern.frame_hz={frame_hz} must be in 5..20, the turns per second it can do")
    return frame_hz
