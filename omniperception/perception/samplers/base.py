"""The interface of samplers of point clouds, without Warp; the samplers stand in sampling.py."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch


@dataclass(frozen=True)
class Attitude:
    """Orientation of N bases and the mount of their sensors.

    Attributes:
        base_quat: (N, 4) float32, (w, x, y, z), orientation of the bases in the world.
        mount_pos: sensor position in the base frame, metres.
        mount_quat: sensor orientation in the base frame, (w, x, y, z).
    """

    base_quat: torch.Tensor
    mount_pos: tuple[float, float, float]
    mount_quat: tuple[float, float, float, float]


class Sampler(ABC):
    """Writes a fixed number of points per environment from one frame of rays.

    Attributes:
        num_points: P, points written per environment.
        max_range: metres; points are divided by it.
        needs_attitude: whether it needs the attitude of the base.
        sizes: P by the parts of a frame, named as the arguments of a network that reads them.
    """

    num_points: int
    max_range: float
    needs_attitude: ClassVar[bool] = False

    def __init__(self, num_points: int, max_range: float, num_threads: int | None = None) -> None:
        if num_points < 1:
            raise ValueError(f"a sampler needs at least one point, got num_points={num_points}")
        if not (math.isfinite(max_range) and max_range > 0.0):
            raise ValueError(f"max_range must be a positive length in metres, got {max_range}")
        self.num_points = num_points
        self.max_range = float(max_range)
        self.num_threads = num_threads

    @property
    def sizes(self) -> dict[str, int]:
        return {"num_points": self.num_points}

    def __call__(
        self,
        ranges: torch.Tensor,
        directions_s: torch.Tensor,
        elevation: torch.Tensor,
        azimuth: torch.Tensor,
        out: torch.Tensor,
        attitude: Attitude | None = None,
    ) -> None:
        """Sample one frame; every element of ``out`` is written.

        Args:
            ranges: (N, R) float32, metres; infinity is a miss. Misses are no points.
            directions_s: (N, R, 3) float32, unit vectors in the sensor frame.
            elevation: (N, R) float32, theta in the sensor frame, radians.
            azimuth: (N, R) float32, phi in the sensor frame, radians, any branch.
            out: (N, P, 3) float32, points in the sensor frame divided by ``max_range``; may be a strided
                slice.
            attitude: orientation of base and sensor, for a sampler with ``needs_attitude``.
        """
        n, r = ranges.shape
        expected = {
            "directions_s": (n, r, 3),
            "elevation": (n, r),
            "azimuth": (n, r),
            "out": (n, self.num_points, 3),
        }
        given = {"directions_s": directions_s, "elevation": elevation, "azimuth": azimuth, "out": out}
        if self.needs_attitude:
            if attitude is None:
                raise ValueError(f"{type(self).__name__} needs the attitude of the base")
            expected["attitude.base_quat"], given["attitude.base_quat"] = (n, 4), attitude.base_quat
        for name, shape in expected.items():
            if tuple(given[name].shape) != shape:
                raise ValueError(f"sampler: {name} must have shape {shape}, got {tuple(given[name].shape)}")
        for name, tensor in {"ranges": ranges, **given}.items():
            if tensor.dtype != torch.float32 or tensor.device != ranges.device:
                raise ValueError(
                    f"sampler: {name} must be float32 on {ranges.device}, got {tensor.dtype} on {tensor.device}"
                )
        self._sample(ranges, directions_s, elevation, azimuth, out, attitude)

    @abstractmethod
    def _sample(self, ranges, directions_s, elevation, azimuth, out, attitude) -> None:
        """Write ``out`` from checked tensors."""
