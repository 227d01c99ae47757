"""Obstacles by azimuth sector from one raw cloud by geometry alone: noise, own body and ground are removed.

Nothing here is learned and nothing reads what a ray really hit. All is batched over environments and rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from omniperception.common.rotations import matrix_of, yaw_of
from omniperception.common.sectors import sector_of, sums_by
from omniperception.perception.samplers.base import Attitude

_RIDGE = 1e-3
"""Weight of the level plane at standing height in each fit, beside returns whose weights sum to 1."""


@dataclass(frozen=True)
class GeometryConfig:
    """What is ground, noise and body; the values were chosen on split=dev, see docs/lab/baselines.md.

    Attributes:
        num_sectors: azimuth sectors of the result; sector 0 starts at -pi in the yaw-aligned frame.
        reach: distance (m) up to which returns count.
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
        min_points: returns that make an obstacle in a sector.
        spread: returns up to this share behind the nearest are the same surface; twice what range noise spreads it.
    """

    num_sectors: int = 72
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
    min_points: int = 1
    spread: float = 0.15

    def __post_init__(self) -> None:
        for name in ("num_sectors", "reach", "standing", "fit_reach", "cell_sectors", "ring", "headroom", "min_points"):
            if getattr(self, name) <= 0:
                raise ValueError(f"GeometryConfig.{name}={getattr(self, name)} must be positive")
        if not 0.0 <= self.near_share <= 1.0:
            raise ValueError(f"GeometryConfig.near_share={self.near_share} must be in 0..1")


class Nearest(NamedTuple):
    """Nearest obstacle by sector.

    Attributes:
        distance: (n, S) m, horizontal, from the base's origin; infinite without one.
        place: (n, S, 2) m, in the yaw-aligned frame; 0 without one.
        returns: (n, S) int64: how many it was told from.
    """

    distance: torch.Tensor
    place: torch.Tensor
    returns: torch.Tensor


def nearest_obstacles(
    ranges: torch.Tensor, directions_s: torch.Tensor, attitude: Attitude, config: GeometryConfig
) -> Nearest:
    """Nearest obstacle by sector from a raw cloud.

    Args:
        ranges: (n, R) m as measured; infinite is a miss.
        directions_s: (n, R, 3) unit vectors in the sensor frame.
        attitude: of the base as measured, and the mount of the sensor.
        config: what is ground, noise and body.
    """
    points, height = standing(ranges, directions_s, attitude, config)
    stands = height < config.headroom
    return by_sector(points[..., :2], stands, config)


def standing(
    ranges: torch.Tensor, directions_s: torch.Tensor, attitude: Attitude, config: GeometryConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """What stands on the ground or hangs over it.

    Args: as of :func:`nearest_obstacles`.

    Returns:
        (n, R, 3) m, the points in the yaw-aligned frame at the base's origin; and (n, R) m, their height above the
        ground below them, infinite for ground, noise, the robot itself and misses.
    """
    in_base, points = _points(ranges, directions_s, attitude)
    counts = ranges.isfinite() & ~own_body(in_base, config)
    is_near = ranges < config.near
    height = height_above_ground(points, counts & ~is_near, config)
    least = config.min_height + config.rise * points[..., :2].norm(dim=-1) + config.lift * _steepness(points, attitude)
    stands = counts & (height > least)
    stands &= ~near_noise(points, stands & is_near & (height < config.headroom), counts, attitude, config)
    return points, torch.where(stands, height, math.inf)


def _points(ranges: torch.Tensor, directions_s: torch.Tensor, attitude: Attitude) -> tuple[torch.Tensor, torch.Tensor]:
    """(n, R, 3) points in the base frame, and in the levelled, yaw-aligned one at the base's origin; misses at the
    sensor."""
    quat = attitude.base_quat
    mount = matrix_of(quat.new_tensor([attitude.mount_quat]))[0]
    rays = torch.where(ranges.isfinite(), ranges, 0.0)[..., None] * directions_s
    in_base = rays @ mount.T + quat.new_tensor(attitude.mount_pos)
    return in_base, in_base @ levelling(quat).transpose(1, 2)


def levelling(base_quat: torch.Tensor) -> torch.Tensor:
    """(n, 3, 3) rotations from the base frame to the yaw-aligned one, by the orientations (n, 4) of the bases."""
    yaw = yaw_of(base_quat)
    cos, sin, zero = yaw.cos(), yaw.sin(), torch.zeros_like(yaw)
    unturn = torch.stack((cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1.0), -1).unflatten(-1, (3, 3))
    return unturn @ matrix_of(base_quat)


def own_body(points_b: torch.Tensor, config: GeometryConfig) -> torch.Tensor:
    """(n, R) bool: which points (n, R, 3) in the base frame may be the robot's own, above and below it too."""
    back, front, side = config.body
    x, y = points_b[..., 0], points_b[..., 1]
    return (x > -back) & (x < front) & (y.abs() < side)


def _steepness(points: torch.Tensor, attitude: Attitude) -> torch.Tensor:
    """(n, R) sine of the angle at which points (n, R, 3) are seen from above; 0 from below."""
    sensor = levelling(attitude.base_quat) @ points.new_tensor(attitude.mount_pos)
    ray = points - sensor[:, None]
    return (-ray[..., 2] / ray.norm(dim=-1).clamp(min=1e-6)).clamp(min=0.0)


def near_noise(
    points: torch.Tensor, near: torch.Tensor, counts: torch.Tensor, attitude: Attitude, config: GeometryConfig
) -> torch.Tensor:
    """(n, R) bool: which returns next to the sensor stand alone among farther ones of their direction: noise.

    Args:
        points: (n, R, 3) m, yaw-aligned frame.
        near: (n, R) bool: the returns in question.
        counts: (n, R) bool: all returns.
        attitude: with the mount of the sensor.
        config: `near_share`.
    """
    sensor = levelling(attitude.base_quat) @ points.new_tensor(attitude.mount_pos)
    sector = sector_of(points[..., :2] - sensor[:, None, :2], config.cell_sectors)
    share = sums_by(sector, near.float(), config.cell_sectors)
    share = share / sums_by(sector, counts.float(), config.cell_sectors).clamp(min=1.0)
    return near & (share.gather(1, sector) < config.near_share)


def height_above_ground(points: torch.Tensor, counts: torch.Tensor, config: GeometryConfig) -> torch.Tensor:
    """(n, R) m: how high points stand above the ground below them, which is found from the lowest ones.

    A plane is fitted to what lies near the ground, then cells of azimuth and distance give what is left, from the
    inside out: a cell's ground rises above the one before by no more than `slope`, so that the face of an obstacle
    which hides its foot is none.

    Args:
        points: (n, R, 3) m, yaw-aligned frame.
        counts: (n, R) bool: which tell of the ground; those next to the sensor may be noise.
        config: how the ground is found.
    """
    distance = points[..., :2].norm(dim=-1)
    above = points[..., 2] - _plane(points, counts & (distance < config.fit_reach), config)
    rings = math.ceil(config.reach / config.ring)
    ring = (distance / config.ring).long().clamp(max=rings - 1)
    cell = ring * config.cell_sectors + sector_of(points[..., :2], config.cell_sectors)
    counts = counts & (distance < config.reach)
    num = rings * config.cell_sectors
    low = above.new_full((len(above), num), math.inf)
    low.scatter_reduce_(1, cell, torch.where(counts, above, math.inf), "amin")
    is_low = counts & (above <= low.gather(1, cell) + config.lowest)
    returns = sums_by(cell, is_low.float(), num)
    ground = sums_by(cell, torch.where(is_low, above, 0.0), num) / returns.clamp(min=1.0)
    ground = _outwards(ground.unflatten(1, (rings, -1)), (returns > 0).unflatten(1, (rings, -1)), config)
    return above - ground.flatten(1).gather(1, cell)


def _plane(points: torch.Tensor, counts: torch.Tensor, config: GeometryConfig) -> torch.Tensor:
    """(n, R) m: height of the ground's plane at points (n, R, 3)."""
    at = torch.cat((points[..., :2], torch.ones_like(points[..., :1])), -1)
    standing = points.new_tensor([0.0, 0.0, -config.standing])
    plane = standing.expand(len(points), 3)
    for band in config.bands:
        off = points[..., 2] - (at @ plane[..., None])[..., 0]
        weight = (counts & (off.abs() < band)).float()
        weighted = (weight / weight.sum(1, keepdim=True).clamp(min=1.0))[..., None] * at
        normal = weighted.transpose(1, 2) @ at + _RIDGE * torch.eye(3, device=points.device)
        right = (weighted * points[..., 2:]).sum(1) + _RIDGE * standing
        plane = torch.linalg.solve(normal, right)
    return (at @ plane[..., None])[..., 0]


def _outwards(ground: torch.Tensor, known: torch.Tensor, config: GeometryConfig) -> torch.Tensor:
    """(n, rings, sectors) the cells' ground, limited by the ring before; a cell without returns has the same."""
    before, found = torch.zeros_like(ground[:, 0]), []
    for height, is_known in zip(ground.unbind(1), known.unbind(1), strict=True):
        before = torch.where(is_known, torch.minimum(height, before + config.slope * config.ring), before)
        found.append(before)
    return torch.stack(found, 1)


def by_sector(places: torch.Tensor, counts: torch.Tensor, config: GeometryConfig) -> Nearest:
    """Nearest surface by sector.

    A surface is at the mean of its returns, so that range noise evens out. What has fewer than `min_points` is passed
    over for what stands behind it, once.

    Args:
        places: (n, R, 2) m, yaw-aligned frame.
        counts: (n, R) bool: returns from obstacles.
        config: sectors and surfaces.
    """
    distance = torch.where(counts, places.norm(dim=-1), math.inf)
    sector = sector_of(places, config.num_sectors)
    surface, returns = _nearest_surface(distance, sector, config)
    if config.min_points > 1:
        lonely = surface & (returns.gather(1, sector) < config.min_points)
        distance = torch.where(lonely, math.inf, distance)
        surface, returns = _nearest_surface(distance, sector, config)
        surface &= returns.gather(1, sector) >= config.min_points
        returns = torch.where(returns >= config.min_points, returns, 0.0)
    total = [sums_by(sector, torch.where(surface, value, 0.0), config.num_sectors) for value in places.unbind(-1)]
    place = torch.stack(total, -1) / returns.clamp(min=1.0)[..., None]
    return Nearest(torch.where(returns > 0, place.norm(dim=-1), math.inf), place, returns.long())


def _nearest_surface(
    distance: torch.Tensor, sector: torch.Tensor, config: GeometryConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """(n, R) bool: returns of the nearest surface of each sector, and (n, S) how many there are."""
    nearest = distance.new_full((len(distance), config.num_sectors), math.inf)
    nearest.scatter_reduce_(1, sector, distance, "amin")
    surface = distance.isfinite() & (distance <= (1.0 + config.spread) * nearest.gather(1, sector))
    return surface, sums_by(sector, surface.float(), config.num_sectors)
