"""Clouds of known worlds, from closed forms."""

import math

import numpy as np
import torch

from omniperception.perception import Attitude

HEIGHT = 0.33
"""Of the base's origin above the ground (m)."""
MOUNT = np.array([0.28945, 0.0, -0.046825])
LEVEL = (0.0, 0.0, 0.0)


def rotation(roll, pitch, yaw):
    """Rotation matrix from the base frame to the world, roll first."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def quaternion(roll, pitch, yaw):
    """(w, x, y, z) of the same rotation."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def plane(gradient=(0.0, 0.0)):
    """Ground through the foot of the base, rising by `gradient` (m/m)."""
    normal = np.array([-gradient[0], -gradient[1], 1.0])

    def hit(origin, rays):
        with np.errstate(divide="ignore"):
            distance = -(normal @ origin + HEIGHT) / (rays @ normal)
        return np.where(distance > 0, distance, np.inf)

    return hit


def box(low, high):
    """An upright box between two corners (m; z above the ground), by slabs."""
    low, high = np.array(low) - [0, 0, HEIGHT], np.array(high) - [0, 0, HEIGHT]

    def hit(origin, rays):
        with np.errstate(divide="ignore"):
            first, last = (low - origin) / rays, (high - origin) / rays
        near, far = np.minimum(first, last).max(1), np.maximum(first, last).min(1)
        return np.where((near <= far) & (near > 0), near, np.inf)

    return hit


def cylinder(x, y, radius, height):
    """An upright cylinder that stands on the ground, without its lid."""

    def hit(origin, rays):
        ox, oy, a = origin[0] - x, origin[1] - y, (rays[:, :2] ** 2).sum(1)
        b = ox * rays[:, 0] + oy * rays[:, 1]
        under = b * b - a * (ox * ox + oy * oy - radius**2)
        distance = (-b - np.sqrt(np.maximum(under, 0.0))) / a
        z = origin[2] + distance * rays[:, 2] + HEIGHT
        return np.where((under > 0) & (distance > 0) & (z > 0) & (z < height), distance, np.inf)

    return hit


def cloud(*surfaces, attitude=LEVEL, noise=0.0, masked=0.0, sigma=0.0, num_rays=4000, seed=0):
    """Ranges and directions (1, R) of rays from the mount, 60 degrees down to 15 up, and the attitude of the base.

    The sensor is mounted upright. Surfaces are in the frame of the levelled base, as results are.
    """
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-math.pi, math.pi, num_rays), np.deg2rad(rng.uniform(-60, 15, num_rays))
    rays_b = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), 1)
    level = rotation(attitude[0], attitude[1], 0.0)
    ranges = np.min([surface(level @ MOUNT, rays_b @ level.T) for surface in surfaces], 0)
    ranges = ranges * (1 + noise * rng.uniform(-1, 1, num_rays)) + sigma * rng.normal(size=num_rays)
    short = (rng.random(num_rays) < masked) & np.isfinite(ranges)
    ranges = np.where(short, rng.uniform(0.1, 0.3, num_rays), ranges)
    ranges[ranges > 6.0] = np.inf
    quat = torch.tensor([quaternion(*attitude)], dtype=torch.float32)
    directions = torch.tensor(rays_b[None], dtype=torch.float32)
    given = Attitude(quat, tuple(MOUNT), (1.0, 0.0, 0.0, 0.0))
    return torch.tensor(ranges[None], dtype=torch.float32), directions, given


PAPER = {"noise": 0.1, "masked": 0.1}
