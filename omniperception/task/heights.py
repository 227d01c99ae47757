"""Privileged terrain heights around the robot: 17 x 11 points, 0.1 m apart."""

from __future__ import annotations

import torch
import warp as wp

from omniperception.perception.launch import view
from omniperception.task.state import Kinematics
from omniperception.world import Ground
from omniperception.world.ground_kernels import base_heights, heights_around

NUM_X, NUM_Y, SPACING = 17, 11, 0.1
NUM_HEIGHTS = NUM_X * NUM_Y
MAX_HEIGHT = 1.0
"""Relative heights are clipped to this magnitude (m)."""


def height_grid(device: torch.device | str = "cpu") -> torch.Tensor:
    """(187, 2) points (m) in the yaw-aligned frame, x from -0.8 to 0.8 (slow), y from -0.5 to 0.5 (fast)."""
    x = (torch.arange(NUM_X, device=device) - NUM_X // 2) * SPACING
    y = (torch.arange(NUM_Y, device=device) - NUM_Y // 2) * SPACING
    return torch.stack(torch.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def footprint_grid(device: torch.device | str = "cpu") -> torch.Tensor:
    """(5, 2) points (m) in the yaw-aligned frame whose ground the base's height is measured from: origin and hips."""
    return torch.tensor([[0.0, 0.0], [0.2, 0.1], [0.2, -0.1], [-0.2, 0.1], [-0.2, -0.1]], device=device)


def flat_heights(base_height: torch.Tensor) -> torch.Tensor:
    """(n, 187) heights (m) of bases (n,) above a plane at 0, clipped to +-1 m."""
    return base_height[:, None].expand(-1, NUM_HEIGHTS).clamp(-MAX_HEIGHT, MAX_HEIGHT)


class HeightLookup:
    """Heights of the robots above the ground around them, each kind in one launch over all environments."""

    def __init__(self, ground: Ground, num_envs: int, device: torch.device) -> None:
        self._ground, self._num_envs = ground, num_envs
        self._grid, self._footprint = height_grid(device), footprint_grid(device)
        self._base_pos_w, self._yaw = torch.zeros(num_envs, 3, device=device), torch.zeros(num_envs, device=device)
        self._base_height = torch.zeros(num_envs, device=device)
        self._heights = torch.zeros(num_envs, NUM_HEIGHTS, device=device)

    def place(self, kinematics: Kinematics) -> None:
        """Where the robots are, for the look-ups that follow."""
        self._base_pos_w.copy_(kinematics.base_pos_w)
        self._yaw.copy_(kinematics.yaw)

    def base_height(self) -> torch.Tensor:
        """(num_envs,) height (m) of the base's origin above the mean of the ground at `footprint_grid`."""
        self._launch(base_heights, self._footprint, [view(self._base_height, wp.float32)])
        return self._base_height.clone()

    def around(self) -> torch.Tensor:
        """(num_envs, 187) height (m) of the base's origin above the ground at `height_grid`, clipped to +-1 m."""
        self._launch(heights_around, self._grid, [MAX_HEIGHT, view(self._heights, wp.float32)])
        return self._heights.clone()

    def _launch(self, kernel: wp.Kernel, points: torch.Tensor, outputs: list) -> None:
        robots = [view(self._base_pos_w, wp.float32), view(self._yaw, wp.float32), view(points, wp.vec2)]
        self._ground.launch(kernel, [*robots, *outputs], self._num_envs, len(points))
