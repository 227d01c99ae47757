"""Obstacles by azimuth sector from one raw cloud by geometry alone: noise, own body and ground are removed.

Nothing here is learned and nothing reads what a ray really hit. All is batched over environments and rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import warp as wp

from omnilidar.launch import constant, launch_over_envs, view
from omniperception.common.sectors import sector_of, sums_by
from omniperception.perception.samplers.base import Attitude
from omniperception.perception.standing_kernels import Settings, find_standing

_SETTINGS = (
    *("reach", "near", "near_share", "standing", "fit_reach", "ring", "lowest", "slope", "min_height", "rise", "lift"),
    "headroom",
)

NUM_SECTORS = 72
"""Azimuth sectors of the nearest obstacles; sector 0 starts at -pi in the yaw-aligned frame."""

_SPREAD = 0.15
"""Returns up to this share behind the nearest are the same surface; twice what range noise spreads it."""


@dataclass(frozen=True)
class GeometryConfig:
    """What is ground, noise and body; the values were chosen on split=dev, see docs/lab/worlds.md.

    Attributes:
        reach: distance (m) up to which returns tell where the ground is; what lies farther away stands on the ground of
            the outermost ring.
        body: (back, front, side) (m) from the base's origin in the base frame: returns inside are the robot's own.
        near, near_share: returns nearer to the sensor than `near` (m) count where they are at least this share of a
            sector's returns; fewer are noise.
        standing: height (m) of the base's origin above the ground, where the search for the ground begins.
        bands: a plane is fitted to the returns within this (m) of the one before, once for each.
        fit_reach: distance (m) up to which returns tell the plane.
        cell_sectors, ring: cells of the local ground: azimuth sectors, and depth (m) of the rings around the base.
        lowest: returns up to this (m) above the lowest of a cell are its ground: how far range noise spreads them.
        slope: most that the local ground rises outwards against the plane.
        min_height, rise: returns that stand at most this (m) above the ground are ground, and by so much (m/m) more
            with the distance from the base.
        lift: likewise (m), times the sine of the angle at which they are seen from above: range noise lifts those most
            that lie steeply below.
        headroom: returns at least this (m) above it hang too high to matter.
    """

    reach: float = 6.0
    body: tuple[float, float, float] = (0.5, 0.36, 0.32)
    near: float = 0.32
    near_share: float = 0.35
    standing: float = 0.33
    bands: tuple[float, ...] = (0.25, 0.25, 0.25, 0.15, 0.08)
    fit_reach: float = 2.5
    cell_sectors: int = 24
    ring: float = 0.3
    lowest: float = 0.06
    slope: float = 0.2
    min_height: float = 0.05
    rise: float = 0.005
    lift: float = 0.08
    headroom: float = 0.45

    def __post_init__(self) -> None:
        for name in ("reach", "standing", "fit_reach", "cell_sectors", "ring", "headroom"):
            if getattr(self, name) <= 0:
                raise ValueError(f"perception.sampler.geometry.{name}={getattr(self, name)} must be positive")
        if not 0.0 <= self.near_share <= 1.0:
            raise ValueError(f"perception.sampler.geometry.near_share={self.near_share} must be in 0..1")


class Nearest(NamedTuple):
    """Nearest obstacle by sector.

    Attributes:
        distance: (n, S) m, horizontal, from the base's origin; infinite without one.
        place: (n, S, 2) m, in the yaw-aligned frame; 0 without one.
    """

    distance: torch.Tensor
    place: torch.Tensor


def nearest_obstacles(
    ranges: torch.Tensor, directions_s: torch.Tensor, attitude: Attitude, standing: Standing
) -> Nearest:
    """Nearest obstacle by sector from a raw cloud.

    Args:
        ranges: (n, R) m as measured; infinite is a miss.
        directions_s: (n, R, 3) unit vectors in the sensor frame.
        attitude: of the base as measured, and the mount of the sensor.
        standing: tells what is ground, noise and body; its memory is used again.
    """
    points, height = standing(ranges, directions_s, attitude)
    return by_sector(points[..., :2], height < standing.config.headroom)


class Standing:
    """Tells what stands on the ground, or hangs over it, from ground, noise, and the robot's own body.

    A plane is fitted to what lies near the ground, then cells of azimuth and distance give what is left, from the
    inside out: a cell's ground rises above the one before by no more than `slope`, so that the face of an obstacle
    which hides its foot is none. Returns next to the sensor that stand alone among farther ones of their direction are
    noise.

    Attributes:
        config: what is ground, noise and body.
    """

    def __init__(self, config: GeometryConfig, num_threads: int | None = None) -> None:
        """Args: num_threads: CPU threads; those of `use_threads` by default."""
        self.config, self._num_threads = config, num_threads
        self._settings = Settings()
        self._settings.back, self._settings.front, self._settings.side = config.body
        self._settings.rings = math.ceil(config.reach / config.ring)
        self._settings.sectors = config.cell_sectors
        for name in _SETTINGS:
            setattr(self._settings, name, getattr(config, name))
        self._memory: tuple[torch.Tensor, ...] = ()

    def __call__(
        self, ranges: torch.Tensor, directions_s: torch.Tensor, attitude: Attitude
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Args: as of :func:`nearest_obstacles`.

        Returns:
            (n, R, 3) m, the points in the yaw-aligned frame at the base's origin; and (n, R) m, their height above the
            ground below them, infinite for ground, noise, the robot itself and misses. Memory of the next call.
        """
        n, device = len(ranges), ranges.device
        cells, low, ground, returns, around, points, heights = self._memory_for(n, ranges.shape[1], device)
        inputs = [
            view(ranges, wp.float32),
            view(directions_s, wp.vec3),
            view(attitude.base_quat, wp.vec4),
            wp.vec3(*attitude.mount_pos),
            wp.vec4(*attitude.mount_quat),
            view(constant(self.config.bands, device), wp.float32),
            self._settings,
            view(cells, wp.int32),
            view(low, wp.float32),
            view(ground, wp.float32),
            view(returns, wp.int32),
            view(around, wp.int32),
            view(points, wp.vec3),
            view(heights, wp.float32),
        ]
        launch_over_envs(find_standing, n, inputs, device, num_threads=self._num_threads)
        return points, heights

    def _memory_for(self, n: int, r: int, device: torch.device) -> tuple[torch.Tensor, ...]:
        """For n environments of r rays; allocated when there are more of them than before."""
        most = self._memory[-1] if self._memory else None
        if most is None or len(most) < n or most.shape[1] != r or most.device != device:
            num_cells, sectors = self._settings.rings * self._settings.sectors, self._settings.sectors
            shapes = (
                ((n, r), torch.int32),  # cells
                ((n, num_cells), torch.float32),  # low
                ((n, num_cells), torch.float32),  # ground
                ((n, num_cells), torch.int32),  # returns
                ((n, 2 * sectors), torch.int32),  # around
                ((n, r, 3), torch.float32),  # points
                ((n, r), torch.float32),  # heights
            )
            with torch.inference_mode(False):
                self._memory = tuple(torch.empty(shape, dtype=dtype, device=device) for shape, dtype in shapes)
        return tuple(tensor[:n] for tensor in self._memory)


def by_sector(places: torch.Tensor, counts: torch.Tensor, num_sectors: int = NUM_SECTORS) -> Nearest:
    """Nearest surface by sector, at the mean of its returns, so that range noise evens out.

    Args:
        places: (n, R, 2) m, yaw-aligned frame.
        counts: (n, R) bool: returns from obstacles.
        num_sectors: S.
    """
    distance = torch.where(counts, places.norm(dim=-1), math.inf)
    sector = sector_of(places, num_sectors)
    nearest = distance.new_full((len(distance), num_sectors), math.inf)
    nearest.scatter_reduce_(1, sector, distance, "amin")
    surface = distance.isfinite() & (distance <= (1.0 + _SPREAD) * nearest.gather(1, sector))
    returns = sums_by(sector, surface.float(), num_sectors)
    total = [sums_by(sector, torch.where(surface, value, 0.0), num_sectors) for value in places.unbind(-1)]
    place = torch.stack(total, -1) / returns.clamp(min=1.0)[..., None]
    return Nearest(torch.where(returns > 0, place.norm(dim=-1), math.inf), place)
