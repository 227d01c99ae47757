"""Nearness and motion of obstacles by azimuth sector, from the true poses and outlines of all obstacles."""

from __future__ import annotations

import torch
import warp as wp

from omnilidar.launch import launch_over_envs, view
from omniperception.avoidance.kernels import nearest_by_sector
from omniperception.avoidance.sector_motion import nothing_near
from omniperception.common.rotations import rotate_yaw
from omniperception.scene import ObstacleField, ObstaclesConfig


class TrueSectors:
    """Nearest obstacle of each azimuth sector: how far its outline is from the base, and how it moves.

    Sector j of S holds the bearings [-pi + j 2 pi / S, -pi + (j + 1) 2 pi / S) of the yaw-aligned frame. An obstacle is
    in a sector if the sector's middle points at it, at the distance along the middle, or if its nearest point lies
    there; one that reaches in from the side alone is not, so that wide things do not look wider than they are. Outlines
    are circles and rectangles, seen from above. Obstacles that do not take part, or that hang at least
    `ObstaclesConfig.headroom` above the ground, do not count.

    Attributes:
        names: of the obstacles, in the order of the masks.
    """

    def __init__(
        self,
        num_sectors: int,
        obstacles: ObstaclesConfig,
        field: ObstacleField | None,
        num_envs: int,
        device: torch.device,
    ) -> None:
        """Args: num_sectors: S; obstacles: every obstacle; field: where they are, or None without any."""
        self.num_sectors, self._field, self._num_envs, self._device = num_sectors, field, num_envs, device
        self.names = obstacles.geom_names()

    def in_view(self, base_pos_w: torch.Tensor, yaw: torch.Tensor, half_angle: float) -> torch.Tensor:
        """(num_envs, O) bool: obstacles whose circle reaches into the view of `half_angle` (rad) to either side of
        straight ahead. Arguments as `measure` has them."""
        field = self._field
        if field is None:
            return torch.zeros(self._num_envs, 0, dtype=torch.bool, device=self._device)
        x, y = self._places(field, base_pos_w, yaw).unbind(-1)
        reach = (field.radius.float() / torch.hypot(x, y).clamp(min=1e-6)).clamp(max=1.0)
        return (torch.atan2(y, x).abs() - torch.asin(reach) <= half_angle) | (reach == 1.0)

    def measure(self, base_pos_w: torch.Tensor, yaw: torch.Tensor, known: torch.Tensor | None = None) -> torch.Tensor:
        """Distances and velocities at the present state of the obstacles.

        Args:
            base_pos_w: (num_envs, 3) m, where the robots are.
            yaw: (num_envs,) rad, their headings.
            known: (num_envs, O) bool the obstacles that count; None for all.

        Returns:
            (num_envs, S, 3) distance (m, horizontal, infinite without an obstacle) and velocity (m/s, yaw-aligned).
        """
        out = nothing_near(self._num_envs, self.num_sectors, self._device)
        field = self._field
        if field is not None:
            counts = field.in_the_way()
            if known is not None:
                counts = counts & known
            place = self._places(field, base_pos_w, yaw)
            velocity = rotate_yaw(-yaw, field.velocity_w.float())
            heading = field.yaw.float() - yaw[:, None]
            axis, outline = torch.stack((heading.cos(), heading.sin()), -1), field.outline.float()
            inputs = [
                view(place, wp.vec2),
                view(axis, wp.vec2),
                view(velocity, wp.vec2),
                view(counts, wp.bool),
                view(outline, wp.vec2),
                view(out, wp.vec3),
            ]
            launch_over_envs(nearest_by_sector, self._num_envs, inputs, self._device)
        return out

    @staticmethod
    def _places(field: ObstacleField, base_pos_w: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
        """(num_envs, O, 2) m, yaw-aligned frame: the obstacles' middles."""
        return rotate_yaw(-yaw, field.pos_w[..., :2].float() - base_pos_w[:, None, :2])
