"""Heights of the robots above a ground that is not flat, looked up by Warp kernels."""

from __future__ import annotations

import torch
import warp as wp

from omnilidar.launch import view
from omniperception.env.heights import MAX_HEIGHT, NUM_HEIGHTS, footprint_grid, height_grid
from omniperception.env.kinematics import Kinematics
from omniperception.scene.ground import Ground
from omniperception.scene.ground_kernels import base_heights, heights_around


class HeightLookup:
    """Heights of the robots above the ground around them, each kind in one launch over all environments."""

    def __init__(self, ground: Ground, num_envs: int, device: torch.device, footprint: tuple[float, float]) -> None:
        """`footprint`: half length and half width (m) of what the base's height is measured from."""
        self._ground, self._num_envs = ground, num_envs
        self._grid, self._footprint = height_grid(device), footprint_grid(*footprint, device)
        self._base_pos_w, self._yaw = torch.zeros(num_envs, 3, device=device), torch.zeros(num_envs, device=device)
        self._base_height = torch.zeros(num_envs, device=device)
        self._heights = torch.zeros(num_envs, NUM_HEIGHTS, device=device)

    def base_height(self, kinematics: Kinematics) -> torch.Tensor:
        """(num_envs,) height (m) of the base's origin above the mean of the ground at `footprint_grid`."""
        self._launch(base_heights, kinematics, self._footprint, [view(self._base_height, wp.float32)])
        return self._base_height.clone()

    def around(self, kinematics: Kinematics) -> torch.Tensor:
        """(num_envs, 187) height (m) of the base's origin above the ground at `height_grid`, clipped to +-1 m."""
        self._launch(heights_around, kinematics, self._grid, [MAX_HEIGHT, view(self._heights, wp.float32)])
        return self._heights.clone()

    def ground(self, pos_w: torch.Tensor) -> torch.Tensor:
        """(num_envs, P) height (m) of the ground below points (num_envs, P, 3), environment frame."""
        return self._ground.height(pos_w[..., :2])

    def _launch(self, kernel: wp.Kernel, kinematics: Kinematics, points: torch.Tensor, outputs: list) -> None:
        self._base_pos_w.copy_(kinematics.base_pos_w)
        self._yaw.copy_(kinematics.yaw)
        robots = [view(self._base_pos_w, wp.float32), view(self._yaw, wp.float32), view(points, wp.vec2)]
        self._ground.launch(kernel, [*robots, *outputs], self._num_envs, len(points))
