"""What stands on the ground, from one robot's cloud: `omniperception.perception.geometry` in NumPy.

Settings, and why everything is done as it is done, stand there (:class:`GeometryConfig`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

_RIDGE = np.float32(1e-3)


def sector_of(places: np.ndarray, num_sectors: int) -> np.ndarray:
    """(n,) azimuth sector of places (n, 2); sector 0 starts at -pi."""
    turned = np.arctan2(places[:, 1], places[:, 0]) + np.float32(math.pi)
    return np.clip((turned * np.float32(num_sectors / (2.0 * math.pi))).astype(np.int64), 0, num_sectors - 1)


def standing(
    points_b: np.ndarray, ranges: np.ndarray, level: np.ndarray, sensor_b: np.ndarray, settings: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """What stands on the ground or hangs over it.

    Args:
        points_b: (n, 3) float32 m, hits in the base frame.
        ranges: (n,) float32 m, their distance from the sensor.
        level: (3, 3) rotation from the base frame to the levelled, yaw-aligned one.
        sensor_b: (3,) m, the sensor in the base frame.
        settings: of `GeometryConfig`, by name.

    Returns:
        (n, 3) float32 m, the points in the levelled frame; and (n,) float32 m, their height above the ground below
        them, infinite for ground, noise and the robot itself.
    """
    level, sensor = level.astype(np.float32), (level @ sensor_b).astype(np.float32)
    points = points_b @ level.T
    back, front, side = settings["body"]
    on_body = (points_b[:, 0] > -back) & (points_b[:, 0] < front) & (abs(points_b[:, 1]) < side)
    is_near = ranges < np.float32(settings["near"])
    height = _height_above_ground(points, ~on_body & ~is_near, settings)
    ray = points - sensor
    steepness = np.maximum(-ray[:, 2] / np.maximum(np.linalg.norm(ray, axis=1), np.float32(1e-6)), np.float32(0.0))
    away = np.linalg.norm(points[:, :2], axis=1)
    least = settings["min_height"] + settings["rise"] * away + settings["lift"] * steepness
    stands = ~on_body & (height > least)
    near = stands & is_near & (height < settings["headroom"])
    stands &= ~_near_noise(ray, near, ~on_body, settings)
    return points, np.where(stands, height, np.float32(np.inf))


def _near_noise(rays: np.ndarray, near: np.ndarray, counts: np.ndarray, settings: Mapping[str, Any]) -> np.ndarray:
    """(n,) bool: which of the returns `near` the sensor stand alone among farther ones of their direction."""
    num = settings["cell_sectors"]
    sector = sector_of(rays[:, :2], num)
    share = np.bincount(sector[near], minlength=num) / np.maximum(np.bincount(sector[counts], minlength=num), 1)
    return near & (share[sector] < settings["near_share"])


def _height_above_ground(points: np.ndarray, counts: np.ndarray, settings: Mapping[str, Any]) -> np.ndarray:
    """(n,) m: how high points (n, 3) stand above the ground, which those that `counts` tell."""
    distance = np.linalg.norm(points[:, :2], axis=1)
    above = points[:, 2] - _plane(points, counts & (distance < settings["fit_reach"]), settings)
    rings, sectors = math.ceil(settings["reach"] / settings["ring"]), settings["cell_sectors"]
    ring = np.minimum((distance / np.float32(settings["ring"])).astype(np.int64), rings - 1)
    cell = ring * sectors + sector_of(points[:, :2], sectors)
    counts = counts & (distance < settings["reach"])
    low = np.full(rings * sectors, np.inf, np.float32)
    np.minimum.at(low, cell[counts], above[counts])
    is_low = counts & (above <= low[cell] + np.float32(settings["lowest"]))
    returns = np.bincount(cell[is_low], minlength=len(low))
    ground = np.bincount(cell[is_low], above[is_low], minlength=len(low)) / np.maximum(returns, 1)
    before, rise = np.zeros(sectors), settings["slope"] * settings["ring"]
    ground, known = ground.reshape(rings, sectors), (returns > 0).reshape(rings, sectors)
    for row in range(rings):
        before = ground[row] = np.where(known[row], np.minimum(ground[row], before + rise), before)
    return above - ground.reshape(-1)[cell].astype(np.float32)


def _plane(points: np.ndarray, counts: np.ndarray, settings: Mapping[str, Any]) -> np.ndarray:
    """(n,) m: height of the ground's plane at points (n, 3)."""
    at = np.concatenate((points[:, :2], np.ones_like(points[:, :1])), 1)
    plane = standing_plane = np.array([0.0, 0.0, -settings["standing"]], np.float32)
    for band in settings["bands"]:
        near = counts & (abs(points[:, 2] - at @ plane) < np.float32(band))
        weighted = at[near] / np.float32(max(near.sum(), 1))
        normal = weighted.T @ at[near] + _RIDGE * np.eye(3, dtype=np.float32)
        plane = np.linalg.solve(normal, weighted.T @ points[near, 2] + _RIDGE * standing_plane)
    return at @ plane
