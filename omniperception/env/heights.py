"""Privileged terrain heights around the robot: 17 x 11 points, 0.1 m apart."""

from __future__ import annotations

import torch

NUM_X, NUM_Y, SPACING = 17, 11, 0.1
NUM_HEIGHTS = NUM_X * NUM_Y
MAX_HEIGHT = 1.0
"""Relative heights are clipped to this magnitude (m)."""


def height_grid(device: torch.device | str = "cpu") -> torch.Tensor:
    """(187, 2) points (m) in the yaw-aligned frame, x from -0.8 to 0.8 (slow), y from -0.5 to 0.5 (fast)."""
    x = (torch.arange(NUM_X, device=device) - NUM_X // 2) * SPACING
    y = (torch.arange(NUM_Y, device=device) - NUM_Y // 2) * SPACING
    return torch.stack(torch.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def footprint_grid(half_x: float, half_y: float, device: torch.device | str = "cpu") -> torch.Tensor:
    """(5, 2) points (m) in the yaw-aligned frame whose ground the base's height is measured from: the origin and the
    corners of a rectangle around it."""
    corners = [[x, y] for x in (half_x, -half_x) for y in (half_y, -half_y)]
    return torch.tensor([[0.0, 0.0], *corners], device=device)


def flat_heights(base_height: torch.Tensor) -> torch.Tensor:
    """(n, 187) heights (m) of bases (n,) above a plane at 0, clipped to +-1 m."""
    return base_height[:, None].expand(-1, NUM_HEIGHTS).clamp(-MAX_HEIGHT, MAX_HEIGHT)
