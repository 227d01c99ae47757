"""Synthetic LiDAR frames for the sampler tests."""

import math

import numpy as np
import torch

MAX_RANGE = 8.0


def rays_from_points(points):
    """Rays (ranges, directions, theta, phi), each (1, R, ...), that hit the given sensor-frame points (R,
    3)."""
    points = torch.as_tensor(points, dtype=torch.float32).reshape(1, -1, 3)
    ranges = points.norm(dim=-1)
    directions = points / ranges.unsqueeze(-1)
    theta = torch.asin(directions[..., 2].clamp(-1, 1))
    return ranges, directions, theta, torch.atan2(points[..., 1], points[..., 0])


def random_rays(num_envs, num_rays, seed=0, miss=0.2):
    """Random rays whose elevations stay away from the borders of 2-degree rings."""
    rng = np.random.default_rng(seed)
    rows = rng.integers(-20, 30, (num_envs, num_rays))
    theta = np.radians(2.0 * rows + rng.uniform(0.2, 1.8, rows.shape))
    phi = rng.uniform(-np.pi, np.pi, rows.shape)
    directions = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)], -1)
    ranges = rng.uniform(0.2, MAX_RANGE, rows.shape)
    ranges[rng.uniform(size=rows.shape) < miss] = np.inf
    return tuple(torch.tensor(a, dtype=torch.float32) for a in (ranges, directions, theta, phi))


def sample(sampler, rays, attitude=None):
    """Sampled points, from an output full of NaN so that an unwritten element shows."""
    out = torch.full((rays[0].shape[0], sampler.num_points, 3), math.nan)
    sampler(*rays, out, attitude)
    assert torch.isfinite(out).all()
    return out
