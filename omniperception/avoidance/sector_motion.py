"""The nearest obstacle of each azimuth sector, how far it is and how it moves, as numbers to regress on."""

from __future__ import annotations

import math

import torch

NEARNESS_RANGE = 4.0
"""Distance (m) from which on an obstacle counts as not near at all."""

LEAST_NEARNESS = 0.05
"""Nearness below which a regressed sector counts as empty."""

VELOCITY_WEIGHT = 1.0
"""Weight of a squared velocity error ((m/s)^2) of an obstacle at the robot, relative to a squared error of nearness."""


def sector_bearings(num_sectors: int, device: torch.device | str = "cpu") -> torch.Tensor:
    """Unit vectors (num_sectors, 2) to the sectors' centres in the yaw-aligned frame; sector 0 starts at -pi."""
    middle = torch.arange(num_sectors, dtype=torch.float32, device=device) + 0.5  # of a type that an exporter keeps
    angle = -math.pi + middle * (2 * math.pi / num_sectors)
    return torch.stack((angle.cos(), angle.sin()), -1)


def nothing_near(num_envs: int, num_sectors: int, device: torch.device | str = "cpu") -> torch.Tensor:
    """(num_envs, num_sectors, 3) distances and velocities where no obstacle is."""
    sectors = torch.zeros(num_envs, num_sectors, 3, device=device)
    sectors[..., 0] = torch.inf
    return sectors


def encode(sectors: torch.Tensor) -> torch.Tensor:
    """Distance and velocity by sector as what a network is regressed on.

    Args:
        sectors: (n, S, 3) distance (m, infinite without an obstacle) and velocity (m/s, yaw-aligned frame).

    Returns:
        (n, S, 3): nearness 1 - d / NEARNESS_RANGE, at least 0, then the velocity away from the robot and the one
        counter-clockwise around it (m/s).
    """
    radial = sector_bearings(sectors.shape[1], sectors.device)
    across = torch.stack((-radial[:, 1], radial[:, 0]), -1)
    nearness = (1 - sectors[..., 0] / NEARNESS_RANGE).clamp(min=0.0)
    velocity = sectors[..., 1:]
    return torch.stack((nearness, (velocity * radial).sum(-1), (velocity * across).sum(-1)), -1)


def decode(motion: torch.Tensor) -> torch.Tensor:
    """(n, S, 3) distance and velocity by sector from what :func:`encode` makes of them."""
    radial = sector_bearings(motion.shape[1], motion.device)
    across = torch.stack((-radial[:, 1], radial[:, 0]), -1)
    nearness = motion[..., 0].clamp(max=1.0)
    distance = torch.where(nearness < LEAST_NEARNESS, torch.inf, NEARNESS_RANGE * (1 - nearness))
    velocity = motion[..., 1:2] * radial + motion[..., 2:] * across
    return torch.cat((distance[..., None], velocity), -1)


def motion_error(predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """(n,) mean over the sectors of the squared errors; a velocity counts as much as its obstacle is near.

    Args:
        predicted: (n, S, 3) as :func:`encode` gives them.
        target: likewise.
    """
    squared = (predicted - target).square()
    weight = VELOCITY_WEIGHT * target[..., 0]
    return (squared[..., 0] + weight * squared[..., 1:].sum(-1)).mean(-1)
