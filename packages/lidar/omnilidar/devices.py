"""Figures of the devices that the patterns simulate, as their makers give them.

``source`` names the document and what in it is a choice of ours. "Not re-checked" marks numbers that were taken from
commonly quoted datasheet values without the document at hand.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from .noise import AngularJitter, GaussianNoise, Noise, TabulatedNoise
from .patterns import (
    ScanPattern,
    airy,
    avia,
    hap,
    hdl32e,
    hdl64e,
    horizon,
    mid40,
    mid70,
    mid360,
    mid360_measured,
    os0,
    os1,
    os2,
    tele15,
    unitree_l1,
    unitree_l2,
    vlp16,
    vlp32c,
    xt16,
    xt32,
)


@dataclass(frozen=True)
class DeviceSpec:
    """A commercial sensor, single return.

    Attributes:
        name: Maker and model.
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
        source: Where the numbers are from.
        measured: What recordings of the device show, within the ranges that they cover; empty where there are none.
    """

    name: str
    pattern: Callable[[], ScanPattern]
    horizontal_fov_deg: float
    elevation_deg: tuple[float, float]
    channels: int
    points_per_second: float
    frame_hz: float
    min_range: float
    max_range: float
    range_sigma: float
    angle_sigma_deg: float | None
    source: str
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


_OUSTER = {
    "OS0": (os0, 45.0, 0.5, 35.0, 0.02),
    "OS1": (os1, 22.5, 0.5, 90.0, 0.01),
    "OS2": (os2, 11.25, 0.8, 200.0, 0.03),
}
_OUSTER_SOURCE = (
    "Ouster {} datasheet, Rev 7; precision depends on range, a middle value; minimum range 0.3-0.5 m by firmware"
)


def _ouster(model: str, channels: int) -> DeviceSpec:
    pattern, half, near, far, sigma = _OUSTER[model]
    return DeviceSpec(
        f"Ouster {model}-{channels}",
        partial(pattern, channels),
        360.0,
        (-half, half),
        channels,
        channels * 10_240.0,
        10.0,
        near,
        far,
        sigma,
        0.01,
        _OUSTER_SOURCE.format(model),
    )


def _livox(name: str, pattern: Callable, *specs, source: str) -> DeviceSpec:
    width, elevation, lasers, rate, near, far, sigma, angle_sigma = specs
    return DeviceSpec(
        f"Livox {name}", pattern, width, elevation, lasers, rate, 10.0, near, far, sigma, angle_sigma, source
    )


# fmt: off
DEVICES: dict[str, DeviceSpec] = {
    "mid360": _livox("Mid-360", mid360, 360.0, (-7.0, 52.0), 4, 200_000.0, 0.1, 40.0, 0.02, 0.15,
                     source="Livox Mid-360 user manual v1.0, specifications: sigma at 10 m"),
    "mid360_measured": _livox("Mid-360, as one was measured", mid360_measured, 360.0, (-7.1, 52.5), 4, 200_000.0, 0.1,
                              40.0, 0.02, 0.15, source="two frames of one Livox device (docs/lab/fidelity.md); ranges "
                                                       "and sigmas: Livox Mid-360 user manual v1.0"),
    "avia": _livox("Avia", avia, 70.4, (-38.6, 38.6), 6, 240_000.0, 1.0, 190.0, 0.02, 0.05,
                   source="Livox Avia user manual, specifications: sigma at 20 m"),
    "hap": _livox("HAP", hap, 120.0, (-12.5, 12.5), 6, 452_000.0, 0.5, 150.0, 0.02, 0.1,
                  source="Livox HAP (TX) user manual, table 1.2.1: sigma at 20 m and 80 %"),
    "horizon": _livox("Horizon", horizon, 81.7, (-12.55, 12.55), 6, 240_000.0, 0.5, 90.0, 0.02, 0.05,
                      source="Livox Horizon user manual v1.0, specifications: sigma at 20 m; not re-checked"),
    "mid40": _livox("Mid-40", mid40, 38.4, (-19.2, 19.2), 1, 100_000.0, 1.0, 90.0, 0.02, 0.1,
                    source="Livox Mid series user manual v1.0, specifications: sigma at 20 m; not re-checked"),
    "mid70": _livox("Mid-70", mid70, 70.4, (-35.2, 35.2), 1, 100_000.0, 0.05, 90.0, 0.02, 0.1,
                    source="Livox Mid-70 user manual v1.2, specifications: sigma at 25 m; not re-checked"),
    "tele15": _livox("Tele-15", tele15, 14.5, (-8.1, 8.1), 6, 240_000.0, 3.0, 320.0, 0.02, 0.03,
                     source="Livox Tele-15 user manual v1.0, specifications: sigma at 20 m; not re-checked"),
    "hdl64e": DeviceSpec("Velodyne HDL-64E", hdl64e, 360.0, (-24.33, 2.0), 64, 4e6 / 3.0, 10.0, 0.9, 120.0, 0.02, None,
                         "Velodyne HDL-64E S2 user's manual; reflectivity of the range not given; not re-checked"),
    "hdl32e": DeviceSpec("Velodyne HDL-32E", hdl32e, 360.0, (-30.67, 10.67), 32, 32 / 46.08e-6, 10.0, 1.0, 100.0, 0.02,
                         None, "Velodyne HDL-32E user's manual: vertical angles, firing order; range sigma at 25 m"),
    "vlp16": DeviceSpec("Velodyne VLP-16", vlp16, 360.0, (-15.0, 15.0), 16, 16 / 55.296e-6, 10.0, 0.5, 100.0, 0.03,
                        None, "Velodyne VLP-16 user manual 63-9243: angles, firing times; ranges not re-checked"),
    "vlp32c": DeviceSpec("Velodyne VLP-32C", vlp32c, 360.0, (-25.0, 15.0), 32, 32 / 55.296e-6, 10.0, 1.0, 200.0, 0.03,
                         None, "Velodyne VLP-32C user manual 63-9325: angles, firing times; ranges not re-checked"),
    **{f"{model.lower()}_{channels}": _ouster(model, channels) for model in _OUSTER for channels in (128, 64, 32)},
    "xt32": DeviceSpec("Hesai XT32", xt32, 360.0, (-16.0, 15.0), 32, 640_000.0, 10.0, 0.05, 80.0, 0.005, None,
                       "Hesai PandarXT user manual and SDK (angles, firing times); ranges not re-checked"),
    "xt16": DeviceSpec("Hesai XT16", xt16, 360.0, (-15.0, 15.0), 16, 320_000.0, 10.0, 0.05, 80.0, 0.005, None,
                       "Hesai PandarXT-16 user manual and SDK (angles, firing times); ranges not re-checked"),
    "unitree_l1": DeviceSpec("Unitree L1", unitree_l1, 360.0, (0.0, 90.0), 1, 21_600.0, 10.0, 0.05, 30.0, 0.02, None,
                             "Unitree 4D LiDAR-L1 user manual (field of view, 21,600 points/s); SDK unilidar_sdk: 120 "
                             "points per sweep, geometry; range at 90 %, turns/s, sigma: product page, not re-checked"),
    "unitree_l2": DeviceSpec("Unitree L2", unitree_l2, 360.0, (0.0, 90.0), 1, 63_936.0, 10.0, 0.05, 30.0, 0.02, None,
                             "Unitree SDK unilidar_sdk2: geometry, standard field of view of 180 deg; user manual and "
                             "product page, not re-checked: 64,000 points/s, sweeps and turns/s, range at 90 %, sigma"),
    "airy": DeviceSpec("RoboSense Airy", airy, 360.0, (0.0, 90.0), 96, 864_000.0, 10.0, 0.1, 30.0, 0.02, None,
                       "RoboSense Airy product page and driver (rs_driver); ranges not re-checked"),
}
# fmt: on
"""Every commercial sensor, by the name of its preset."""

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

for _name, _table in _RECORDED.items():
    DEVICES[_name] = replace(
        DEVICES[_name], measured=(TabulatedNoise(*_table, sigma_elsewhere=DEVICES[_name].range_sigma),)
    )
