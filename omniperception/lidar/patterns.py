"""Scan patterns: the directions in which a LiDAR looks, as a function of time."""

import math
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal

import numpy as np
import torch

ROW_SLACK = 1e-3
"""Fraction of a row within which a time counts as that row's; float64 seconds are this exact after 10^6 s."""


@dataclass(frozen=True)
class ScanPattern:
    """A table of directions; row i is emitted at time ``i / points_per_second``, and the table repeats.

    Attributes:
        directions_s: Unit vectors in the sensor frame, (M, 3) float32.
        elevation: Angle above the sensor's xy plane, rad, (M,) float32.
        azimuth: Angle from the sensor's x axis towards y, rad in [0, 2 pi), (M,) float32.
        points_per_second: Emission rate of the device.
        num_lasers: Lasers that fire in turn, so that rows i and i + num_lasers are of the same one.
    """

    directions_s: torch.Tensor
    elevation: torch.Tensor
    azimuth: torch.Tensor
    points_per_second: float
    num_lasers: int = 1

    def __post_init__(self) -> None:
        rows = self.elevation.shape
        if len(rows) != 1 or rows[0] < 1 or self.azimuth.shape != rows or self.directions_s.shape != (*rows, 3):
            raise ValueError(
                f"pattern needs directions_s (M, 3), elevation (M,) and azimuth (M,), M >= 1; got "
                f"{tuple(self.directions_s.shape)}, {tuple(rows)} and {tuple(self.azimuth.shape)}"
            )
        if not (self.points_per_second > 0.0 and math.isfinite(self.points_per_second)):
            raise ValueError(f"pattern.points_per_second={self.points_per_second} must be positive and finite")
        if not torch.isfinite(self.directions_s).all():
            raise ValueError("pattern.directions_s must be finite")
        norms = torch.linalg.vector_norm(self.directions_s, dim=1)
        if (norms - 1.0).abs().max() > 1e-4:
            raise ValueError(f"pattern.directions_s must be unit vectors; norms span {norms.min()}..{norms.max()}")

    @classmethod
    def from_angles(
        cls, elevation: np.ndarray, azimuth: np.ndarray, points_per_second: float, num_lasers: int = 1
    ) -> "ScanPattern":
        """A pattern from elevation and azimuth, rad, (M,) each; computed in float64, stored in float32."""
        elevation = np.asarray(elevation, dtype=np.float64)
        azimuth = np.mod(np.asarray(azimuth, dtype=np.float64), 2.0 * math.pi)
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)],
            axis=1,
        )
        return cls(
            *(torch.from_numpy(a.astype(np.float32)) for a in (directions, elevation, azimuth)),
            points_per_second,
            num_lasers,
        )

    @property
    def num_rows(self) -> int:
        """Rows of the table, M."""
        return self.elevation.shape[0]

    def points_per_frame(self, period_s: float) -> int:
        """How many points the device measures in ``period_s``; at least 1."""
        return max(1, math.floor(period_s * self.points_per_second + ROW_SLACK))

    def stride(self, period_s: float, num_rays: int) -> int:
        """k, where every k-th point of a frame is kept to have ``num_rays`` of them evenly.

        The largest k that fits and has no factor in common with ``num_lasers``, so that every laser takes part.
        """
        points = self.points_per_frame(period_s)
        if not 1 <= num_rays <= points:
            raise ValueError(
                f"lidar.num_rays={num_rays} must be in 1..{points}, the points measured in "
                f"lidar.period_s={period_s} at {self.points_per_second:g} points/s"
            )
        stride = points // num_rays
        while math.gcd(stride, self.num_lasers) > 1:
            stride -= 1
        return stride

    def first_rows(
        self,
        time: torch.Tensor,
        period_s: float,
        phase_rows: torch.Tensor | int = 0,
        out: torch.Tensor | None = None,
        scratch: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Table row of the first point of the frame that ends at ``time``.

        Args:
            time: End of the frame, s, (num_envs,) float64.
            period_s: Length of the frame: it holds the points of [time - period_s, time).
            phase_rows: Rows by which each environment's device is ahead, int64, (num_envs,) or scalar.
            out: Where to write, (num_envs,) int64.
            scratch: Work space, (num_envs,) float64.

        Returns:
            ``out``, in 0..M-1.
        """
        rows = torch.sub(time, period_s, out=scratch).mul_(self.points_per_second).sub_(ROW_SLACK).ceil_()
        out = torch.empty_like(rows, dtype=torch.int64) if out is None else out
        return out.copy_(rows).add_(phase_rows).remainder_(self.num_rows)


def select_rows(
    pattern: ScanPattern,
    time: torch.Tensor,
    period_s: float,
    num_rays: int,
    phase_rows: torch.Tensor | int = 0,
) -> torch.Tensor:
    """Table rows of the frame that ends at ``time``: every k-th point of [time - period_s, time).

    Args:
        pattern: The device's table.
        time: End of the frame, s, (num_envs,) float64.
        period_s: Length of the frame, s.
        num_rays: Points kept, every ``pattern.stride``-th, starting with the frame's first.
        phase_rows: Rows by which each environment's device is ahead, int64, (num_envs,) or scalar.

    Returns:
        Rows in 0..M-1, (num_envs, num_rays) int64; exact also after 10^6 s.
    """
    first = pattern.first_rows(time, period_s, phase_rows)
    steps = torch.arange(num_rays, device=time.device) * pattern.stride(period_s, num_rays)
    return (first[:, None] + steps).remainder_(pattern.num_rows)


def grid(width: int, height: int, fov_deg: float, frames_per_second: float = 30.0) -> ScanPattern:
    """Rays of a pinhole camera that looks along +x, with +y to the left and +z up; one frame is one table.

    Args:
        width: Pixels per row; a ray goes through the centre of each pixel.
        height: Rows, listed from the top, each from left to right.
        fov_deg: Horizontal opening angle in degrees, below 180; pixels are square.
        frames_per_second: Rate of whole frames.
    """
    if width < 1 or height < 1:
        raise ValueError(f"grid width={width} and height={height} must be at least 1")
    if not 0.0 < fov_deg < 180.0:
        raise ValueError(f"grid fov_deg={fov_deg} must be between 0 and 180")
    pixel = 2.0 * math.tan(math.radians(fov_deg) / 2.0) / width
    left = (width / 2.0 - 0.5 - np.arange(width)) * pixel
    up = (height / 2.0 - 0.5 - np.arange(height)) * pixel
    up, left = (a.ravel() for a in np.meshgrid(up, left, indexing="ij"))
    return ScanPattern.from_angles(
        np.arctan2(up, np.hypot(1.0, left)), np.arctan2(left, 1.0), width * height * frames_per_second
    )


# --- Livox Mid-360 ------------------------------------------------------------------------------------------
# Closed form fitted by least squares to the 800,000 rows of the manufacturer's scan table (azimuth and
# elevation; 4.0 s at 200,000 points/s): mean angle to the table 0.06 deg, largest 0.3 deg. Four lasers fire
# at each mirror position. Their common centre turns clockwise while its elevation sweeps up and down ten
# times a second, and the row of four turns about that centre once per revolution. All series are in harmonics
# k = 0, 1, ... of the sweep.

MID360_POINTS_PER_SECOND = 200_000.0
MID360_ROWS = 800_000
MID360_LASERS = (3.0, 1.0, -1.0, -3.0)
MID360_SWEEP_HZ = 10.0
MID360_TURNS_PER_SECOND = 182.0 + 5.0 / 12.0
MID360_AZIMUTH_START_DEG = 269.3510
MID360_CENTRE_ELEVATION_DEG = (20.4535, 23.5232, 1.1247, 2.3002, 0.2232, 0.1565, 0.0330, 0.0165, 0.0051)
MID360_CENTRE_ELEVATION_SINE_DEG = (0.0, 0.2746, 0.0217, 0.0251, 0.0053, 0.0033)
MID360_CENTRE_AZIMUTH_DEG = (0.0, 28.4284, 2.3480, 2.6918, 0.5351, 0.3042, 0.0940, 0.0453, 0.0172)
MID360_CENTRE_AZIMUTH_COSINE_DEG = (0.0, -0.2395, -0.0470, -0.0407, -0.0132, -0.0080, -0.0034)
MID360_SPREAD_ELEVATION_DEG = {
    0: 0.9214,
    1: 0.0844,
    -1: 0.0525,
    2: 0.0389,
    -2: 0.1802,
    3: 0.0155,
    -3: 0.0254,
    -4: 0.0354,
}
MID360_SPREAD_AZIMUTH_DEG = {
    0: 1.0488,
    1: 0.1938,
    2: 0.0907,
    -2: -0.2156,
    3: 0.0429,
    -3: -0.0486,
    4: 0.0245,
    -4: -0.0556,
}


def mid360(source: Literal["model", "table"] = "model") -> ScanPattern:
    """The scan of a Livox Mid-360: 360 x (-7.2..52.2) deg, 200,000 points/s, repeating after 4 s.

    Args:
        source: "model" is a closed form within 0.3 deg of the manufacturer's table and needs no data;
            "table" is that table, from the package of the extra ``tables``.
    """
    if source == "model":
        return _mid360_model()
    if source == "table":
        return _livox_table("mid360", MID360_POINTS_PER_SECOND, len(MID360_LASERS))
    raise ValueError(f"mid360 source={source!r} must be 'model' or 'table'")


def _mid360_model() -> ScanPattern:
    time = np.arange(0, MID360_ROWS, 4) / MID360_POINTS_PER_SECOND
    sweep = 2.0 * math.pi * MID360_SWEEP_HZ * time
    turn = 2.0 * math.pi * MID360_TURNS_PER_SECOND * time
    centre_elevation = _series(np.cos, MID360_CENTRE_ELEVATION_DEG, sweep)
    centre_elevation += _series(np.sin, MID360_CENTRE_ELEVATION_SINE_DEG, sweep)
    centre_azimuth = math.radians(MID360_AZIMUTH_START_DEG) - turn
    centre_azimuth += _series(np.sin, MID360_CENTRE_AZIMUTH_DEG, sweep)
    centre_azimuth += _series(np.cos, MID360_CENTRE_AZIMUTH_COSINE_DEG, sweep)
    spread_elevation = _sidebands(np.cos, MID360_SPREAD_ELEVATION_DEG, turn, sweep)
    spread_azimuth = _sidebands(np.sin, MID360_SPREAD_AZIMUTH_DEG, turn, sweep)
    lasers = np.array(MID360_LASERS)
    elevation = centre_elevation[:, None] + spread_elevation[:, None] * lasers
    azimuth = centre_azimuth[:, None] + spread_azimuth[:, None] * lasers
    return ScanPattern.from_angles(elevation.ravel(), azimuth.ravel(), MID360_POINTS_PER_SECOND, len(MID360_LASERS))


def _series(wave: np.ufunc, amplitudes_deg: tuple[float, ...], angle: np.ndarray) -> np.ndarray:
    return np.radians(sum(a * wave(k * angle) for k, a in enumerate(amplitudes_deg) if a))


def _sidebands(wave: np.ufunc, amplitudes_deg: dict[int, float], carrier: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.radians(sum(a * wave(carrier + k * angle) for k, a in amplitudes_deg.items()))


def _livox_table(name: str, points_per_second: float, num_lasers: int) -> ScanPattern:
    try:
        with (files("mujoco_lidar") / "scan_mode" / f"{name}.npy").open("rb") as file:
            table = np.load(file)
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise ModuleNotFoundError(
            f"scan table {name!r} is not installed: pip install omniperception[tables], or use source='model'"
        ) from error
    return ScanPattern.from_angles(table[:, 1], table[:, 0], points_per_second, num_lasers)
