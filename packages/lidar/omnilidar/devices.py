"""Figures of the devices that the patterns simulate, as their makers give them.

``source`` names the document and what in it is a choice of ours. "Not re-checked" marks numbers that were taken from
commonly quoted datasheet values without the document at hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from .noise import AngularJitter, GaussianNoise, Noise, TabulatedNoise

if TYPE_CHECKING:
    from .patterns.table import ScanPattern


@dataclass(frozen=True)
class DeviceSpec:
    """A commercial sensor, single return.

    Attributes:
        name: Maker and model.
        source: Where the numbers are from.
        pattern: Makes its scan pattern.
        horizontal_fov_deg: Width of the field of view, 360 for a spinning sensor.
        elevation_deg: Lowest and highest elevation.
        channels: Lasers, or beams of a spinning sensor.
        points_per_second: Single-return rate.
        frame_hz: Usual rate of frames; non-repetitive scanners have none of their own.
        min_range: Nearer surfaces are not measured, metres.
        max_range: Range at 10 % reflectivity, or the one range that the maker gives, metres.
        range_sigma: Standard deviation of a range, metres.
        angle_sigma_deg: Standard deviation of a direction, degrees; None where none is given.
        measured: What recordings of the device show, within the ranges that they cover; empty where there are none.
    """

    name: str
    source: str
    pattern: Callable[[], ScanPattern]
    horizontal_fov_deg: float
    elevation_deg: tuple[float, float]
    channels: int
    points_per_second: float
    min_range: float
    max_range: float
    range_sigma: float
    angle_sigma_deg: float | None
    frame_hz: float = 10.0
    measured: tuple[Noise, ...] = ()

    @property
    def period_s(self) -> float:
        """Time between frames at the usual rate, seconds."""
        return 1.0 / self.frame_hz

    def noise(self) -> tuple[Noise, ...]:
        """The maker's errors as noise models: normal ranges, and normal directions where the maker gives them."""
        models: list[Noise] = [GaussianNoise(self.range_sigma)]
        if self.angle_sigma_deg is not None:
            models.append(AngularJitter(self.angle_sigma_deg))
        return tuple(models)


_COLUMNS = (
    *("horizontal_fov_deg", "elevation_deg", "channels", "points_per_second", "min_range", "max_range"),
    *("range_sigma", "angle_sigma_deg"),
)
# fmt: off
_TABLE = {
    # preset           fov    elevation        lasers points/s        near  far    sigma  angle
    "mid360":          (360.0, (-7.0, 52.0),    4,     200_000.0,      0.1,  40.0,  0.02,  0.15),
    "mid360_measured": (360.0, (-7.1, 52.5),    4,     200_000.0,      0.1,  40.0,  0.02,  0.15),
    "avia":            (70.4,  (-38.6, 38.6),   6,     240_000.0,      1.0,  190.0, 0.02,  0.05),
    "hap":             (120.0, (-12.5, 12.5),   6,     452_000.0,      0.5,  150.0, 0.02,  0.1),
    "horizon":         (81.7,  (-12.55, 12.55), 6,     240_000.0,      0.5,  90.0,  0.02,  0.05),
    "mid40":           (38.4,  (-19.2, 19.2),   1,     100_000.0,      1.0,  90.0,  0.02,  0.1),
    "mid70":           (70.4,  (-35.2, 35.2),   1,     100_000.0,      0.05, 90.0,  0.02,  0.1),
    "tele15":          (14.5,  (-8.1, 8.1),     6,     240_000.0,      3.0,  320.0, 0.02,  0.03),
    "hdl64e":          (360.0, (-24.33, 2.0),   64,    4e6 / 3.0,      0.9,  120.0, 0.02,  None),
    "hdl32e":          (360.0, (-30.67, 10.67), 32,    32 / 46.08e-6,  1.0,  100.0, 0.02,  None),
    "vlp16":           (360.0, (-15.0, 15.0),   16,    16 / 55.296e-6, 0.5,  100.0, 0.03,  None),
    "vlp32c":          (360.0, (-25.0, 15.0),   32,    32 / 55.296e-6, 1.0,  200.0, 0.03,  None),
    "os0_128":         (360.0, (-45.0, 45.0),   128,   1_310_720.0,    0.5,  35.0,  0.02,  0.01),
    "os0_64":          (360.0, (-45.0, 45.0),   64,    655_360.0,      0.5,  35.0,  0.02,  0.01),
    "os0_32":          (360.0, (-45.0, 45.0),   32,    327_680.0,      0.5,  35.0,  0.02,  0.01),
    "os1_128":         (360.0, (-22.5, 22.5),   128,   1_310_720.0,    0.5,  90.0,  0.01,  0.01),
    "os1_64":          (360.0, (-22.5, 22.5),   64,    655_360.0,      0.5,  90.0,  0.01,  0.01),
    "os1_32":          (360.0, (-22.5, 22.5),   32,    327_680.0,      0.5,  90.0,  0.01,  0.01),
    "os2_128":         (360.0, (-11.25, 11.25), 128,   1_310_720.0,    0.8,  200.0, 0.03,  0.01),
    "os2_64":          (360.0, (-11.25, 11.25), 64,    655_360.0,      0.8,  200.0, 0.03,  0.01),
    "os2_32":          (360.0, (-11.25, 11.25), 32,    327_680.0,      0.8,  200.0, 0.03,  0.01),
    "xt32":            (360.0, (-16.0, 15.0),   32,    640_000.0,      0.05, 80.0,  0.005, None),
    "xt16":            (360.0, (-15.0, 15.0),   16,    320_000.0,      0.05, 80.0,  0.005, None),
    "unitree_l1":      (360.0, (0.0, 90.0),     1,     21_600.0,       0.05, 30.0,  0.02,  None),
    "unitree_l2":      (360.0, (0.0, 90.0),     1,     63_936.0,       0.05, 30.0,  0.02,  None),
    "airy":            (360.0, (0.0, 90.0),     96,    864_000.0,      0.1,  30.0,  0.02,  None),
}
# fmt: on
_OUSTERS = {f"os{k}_{channels}": (k, channels) for k in range(3) for channels in (128, 64, 32)}
_OUSTER = "Ouster {} datasheet, Rev 7; precision depends on range, a middle value; minimum range 0.3-0.5 m by firmware"
_NAMES_AND_SOURCES = {
    "mid360": ("Livox Mid-360", "Livox Mid-360 user manual v1.0, specifications: sigma at 10 m"),
    "mid360_measured": (
        "Livox Mid-360, as one was measured",
        "two frames of one Livox device (docs/lab/fidelity.md); ranges and sigmas: Livox Mid-360 user manual v1.0",
    ),
    "avia": ("Livox Avia", "Livox Avia user manual, specifications: sigma at 20 m"),
    "hap": ("Livox HAP", "Livox HAP (TX) user manual, table 1.2.1: sigma at 20 m and 80 %"),
    "horizon": ("Livox Horizon", "Livox Horizon user manual v1.0, specifications: sigma at 20 m; not re-checked"),
    "mid40": ("Livox Mid-40", "Livox Mid series user manual v1.0, specifications: sigma at 20 m; not re-checked"),
    "mid70": ("Livox Mid-70", "Livox Mid-70 user manual v1.2, specifications: sigma at 25 m; not re-checked"),
    "tele15": ("Livox Tele-15", "Livox Tele-15 user manual v1.0, specifications: sigma at 20 m; not re-checked"),
    "hdl64e": (
        "Velodyne HDL-64E",
        "Velodyne HDL-64E S2 user's manual; reflectivity of the range not given; not re-checked",
    ),
    "hdl32e": (
        "Velodyne HDL-32E",
        "Velodyne HDL-32E user's manual: vertical angles, firing order; range sigma at 25 m",
    ),
    "vlp16": ("Velodyne VLP-16", "Velodyne VLP-16 user manual 63-9243: angles, firing times; ranges not re-checked"),
    "vlp32c": ("Velodyne VLP-32C", "Velodyne VLP-32C user manual 63-9325: angles, firing times; ranges not re-checked"),
    "xt32": ("Hesai XT32", "Hesai PandarXT user manual and SDK (angles, firing times); ranges not re-checked"),
    "xt16": ("Hesai XT16", "Hesai PandarXT-16 user manual and SDK (angles, firing times); ranges not re-checked"),
    "unitree_l1": (
        "Unitree L1",
        "Unitree 4D LiDAR-L1 user manual (field of view, 21,600 points/s); SDK unilidar_sdk: 120 points per "
        "sweep, geometry; range at 90 %, turns/s, sigma: product page, not re-checked",
    ),
    "unitree_l2": (
        "Unitree L2",
        "Unitree SDK unilidar_sdk2: geometry, standard field of view of 180 deg; user manual and product page, "
        "not re-checked: 64,000 points/s, sweeps and turns/s, range at 90 %, sigma",
    ),
    "airy": ("RoboSense Airy", "RoboSense Airy product page and driver (rs_driver); ranges not re-checked"),
    **{name: (f"Ouster OS{k}-{channels}", _OUSTER.format(f"OS{k}")) for name, (k, channels) in _OUSTERS.items()},
}


def _pattern(preset: str) -> ScanPattern:
    """The scan pattern of a device; PyTorch, which it needs, is loaded here."""
    import omnilidar

    if preset in _OUSTERS:
        k, channels = _OUSTERS[preset]
        return getattr(omnilidar, f"os{k}")(channels)
    return getattr(omnilidar, preset)()


_NO_MISSES = (0.0,)
"""Of recordings that leave misses out: how many there are is not known."""
_RECORDED: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    **dict.fromkeys(
        ("mid360", "mid360_measured"),
        (
            (0.25, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 4.4),
            (0.006, 0.007, 0.007, 0.006, 0.006, 0.004, 0.004),
            (0.6, 0.53, 0.175, 0.058, 0.029, 0.007, 0.008),
        ),
    ),
    "vlp16": ((0.5, 16.0), (0.0085,), _NO_MISSES),
    "vlp32c": ((2.0, 16.0), (0.015,), _NO_MISSES),
    "os0_128": ((0.5, 4.0), (0.007,), _NO_MISSES),
    "os1_128": ((8.0, 32.0), (0.0125,), _NO_MISSES),
    "os2_128": ((8.0, 32.0), (0.013,), _NO_MISSES),
    "xt16": ((0.5, 1.0, 2.0, 8.0), (0.0075, 0.0125, 0.0075), (0.0, 0.0, 0.0)),
    "xt32": ((0.2, 1.0, 4.0, 16.0), (0.0045, 0.008, 0.004), (0.0, 0.0, 0.0)),
}
"""Edges of ranges (m), sigma (m) at less than 40 degrees of incidence, share of hits lost (docs/lab/fidelity.md)."""

DEVICES: dict[str, DeviceSpec] = {
    preset: DeviceSpec(
        *_NAMES_AND_SOURCES[preset],
        pattern=partial(_pattern, preset),
        **dict(zip(_COLUMNS, row, strict=True)),  # type: ignore[arg-type]
        measured=(TabulatedNoise(*_RECORDED[preset], sigma_elsewhere=row[6]),) if preset in _RECORDED else (),
    )
    for preset, row in _TABLE.items()
}
"""Every commercial sensor, by the name of its preset."""
