"""A scan pattern as a table of directions, and which of its rows a frame holds."""

import math
from dataclasses import dataclass

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
        points_per_second: Emission rate of the device, single return.
        num_lasers: Lasers that fire in turn, so that rows i and i + num_lasers are of the same one.
        origins_s: Where each ray starts in the sensor frame, metres, (M, 3) float32; None: at the sensor's origin.
        rows_per_shot: Consecutive rows that fire at one instant, the time of the first of them; it divides M.
    """

    directions_s: torch.Tensor
    elevation: torch.Tensor
    azimuth: torch.Tensor
    points_per_second: float
    num_lasers: int = 1
    origins_s: torch.Tensor | None = None
    rows_per_shot: int = 1

    def __post_init__(self) -> None:
        rows = self.elevation.shape
        if len(rows) != 1 or rows[0] < 1 or self.azimuth.shape != rows or self.directions_s.shape != (*rows, 3):
            raise ValueError(
                f"pattern needs directions_s (M, 3), elevation (M,) and azimuth (M,), M >= 1; got "
                f"{tuple(self.directions_s.shape)}, {tuple(rows)} and {tuple(self.azimuth.shape)}"
            )
        if not (self.points_per_second > 0.0 and math.isfinite(self.points_per_second)):
            raise ValueError(f"pattern.points_per_second={self.points_per_second} must be positive and finite")
        if self.num_lasers < 1:
            raise ValueError(f"pattern.num_lasers={self.num_lasers} must be at least 1")
        if self.rows_per_shot < 1 or self.num_rows % self.rows_per_shot:
            raise ValueError(f"pattern.rows_per_shot={self.rows_per_shot} must divide the {self.num_rows} rows")
        for name in ("directions_s", "elevation", "azimuth"):
            if not torch.isfinite(getattr(self, name)).all():
                raise ValueError(f"pattern.{name} must be finite")
        norms = torch.linalg.vector_norm(self.directions_s, dim=1)
        if (norms - 1.0).abs().max() > 1e-4:
            raise ValueError(f"pattern.directions_s must be unit vectors; norms span {norms.min()}..{norms.max()}")
        origins = self.origins_s
        if origins is not None and not (origins.shape == (*rows, 3) and torch.isfinite(origins).all()):
            raise ValueError(f"pattern.origins_s must be finite ({rows[0]}, 3), got {tuple(origins.shape)}")

    @classmethod
    def from_angles(
        cls, elevation: np.ndarray, azimuth: np.ndarray, points_per_second: float, num_lasers: int = 1, **fields
    ) -> "ScanPattern":
        """A pattern from elevation and azimuth, rad, (M,) each; computed in float64, stored in float32.

        ``fields`` are the remaining attributes, as tensors and numbers.
        """
        elevation = np.asarray(elevation, dtype=np.float64)
        azimuth = np.asarray(azimuth, dtype=np.float64)
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)],
            axis=1,
        )
        return cls(_single(directions), _single(elevation), _one_turn(azimuth), points_per_second, num_lasers, **fields)

    @classmethod
    def from_directions(
        cls, directions_s: np.ndarray, points_per_second: float, num_lasers: int = 1, **fields
    ) -> "ScanPattern":
        """A pattern from unit vectors in the sensor frame, (M, 3) float64; ``fields`` as in ``from_angles``."""
        x, y, z = np.asarray(directions_s, dtype=np.float64).T
        elevation, azimuth = np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)
        return cls(
            _single(directions_s), _single(elevation), _one_turn(azimuth), points_per_second, num_lasers, **fields
        )

    @property
    def num_rows(self) -> int:
        """Rows of the table, M."""
        return self.elevation.shape[0]

    @property
    def duration_s(self) -> float:
        """Seconds after which the table repeats."""
        return self.num_rows / self.points_per_second

    def points_per_frame(self, period_s: float) -> int:
        """Number of points that the device measures in ``period_s``; at least 1."""
        return max(1, math.floor(period_s * self.points_per_second + ROW_SLACK))

    def check_num_rays(self, period_s: float, num_rays: int) -> int:
        """The points of a frame, of which ``num_rays`` can be kept; a ValueError if they cannot."""
        points = self.points_per_frame(period_s)
        if not 1 <= num_rays <= points:
            raise ValueError(
                f"lidar.num_rays={num_rays} must be in 1..{points}, the points measured in "
                f"lidar.period_s={period_s} at {self.points_per_second:g} points/s"
            )
        return points

    def stride(self, period_s: float, num_rays: int) -> int:
        """k, where every k-th point of a frame is kept to have ``num_rays`` of them evenly.

        The largest k that fits and has no factor in common with ``num_lasers``, so that every laser takes part.
        """
        stride = self.check_num_rays(period_s, num_rays) // num_rays
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


def _single(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _one_turn(azimuth: np.ndarray) -> torch.Tensor:
    """float32 angles in [0, 2 pi), also after rounding."""
    azimuth = np.mod(azimuth, 2.0 * math.pi).astype(np.float32)
    azimuth[azimuth >= np.float32(2.0 * math.pi)] = 0.0
    return torch.from_numpy(azimuth)
