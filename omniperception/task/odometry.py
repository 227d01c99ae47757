"""How the base has moved since the last LiDAR frame, as a state estimator tells it."""

from __future__ import annotations

import torch

from omniperception.task.rotations import rotate_yaw
from omniperception.task.state import Kinematics


class Odometry:
    """Adds up the sensed velocity from one frame to the next; the heading is the IMU's."""

    def __init__(self, num_envs: int, control_dt: float, device: torch.device) -> None:
        self._dt = control_dt
        self._travelled_w = torch.zeros(num_envs, 2, device=device)
        self._yaw = torch.zeros(num_envs, device=device)
        self._yaw_before = torch.zeros(num_envs, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    def advance(self, sensed: Kinematics) -> None:
        """One control step."""
        self._yaw = sensed.yaw
        self._yaw_before = torch.where(self._fresh, sensed.yaw, self._yaw_before)
        step = rotate_yaw(sensed.yaw, sensed.base_lin_vel_yaw) * self._dt
        self._travelled_w = torch.where(self._fresh[:, None], 0.0, self._travelled_w + step)
        self._fresh = torch.zeros_like(self._fresh)

    def since_last_frame(self) -> torch.Tensor:
        """(num_envs, 3) x, y (m) and yaw (rad) since the call before, in the levelled base of then; 0 at the first."""
        turned = torch.remainder(self._yaw - self._yaw_before + torch.pi, 2 * torch.pi) - torch.pi
        moved = torch.cat((rotate_yaw(-self._yaw_before, self._travelled_w), turned[:, None]), 1)
        self._yaw_before = self._yaw
        self._travelled_w = torch.zeros_like(self._travelled_w)
        return moved

    def reset(self, env_ids: torch.Tensor) -> None:
        """Some robots stand elsewhere."""
        self._fresh = self._fresh.index_fill(0, env_ids, True)
        self._travelled_w = self._travelled_w.index_fill(0, env_ids, 0.0)

    def state_dict(self) -> dict:
        return {name: getattr(self, name) for name in ("_travelled_w", "_yaw", "_yaw_before", "_fresh")}

    def load_state_dict(self, state: dict) -> None:
        for name, value in state.items():
            setattr(self, name, value)
