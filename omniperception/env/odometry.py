"""Motion of the base since the last LiDAR frame, as a state estimator measures it."""

from __future__ import annotations

import torch

from omniperception.common.rotations import rotate_yaw
from omniperception.env.kinematics import Kinematics


class Odometry:
    """Adds up the measured velocity from one frame to the next; the heading is the IMU's."""

    def __init__(self, num_envs: int, control_dt: float, device: torch.device) -> None:
        self._dt = control_dt
        self._travelled_w = torch.zeros(num_envs, 2, device=device)
        self._yaw = torch.zeros(num_envs, device=device)
        self._yaw_before = torch.zeros(num_envs, device=device)

    def start(self, env_ids: torch.Tensor, measured: Kinematics) -> None:
        """The robots of some environments (n,) stand elsewhere; `measured` of all."""
        yaw = measured.yaw[env_ids]
        self._yaw = self._yaw.index_copy(0, env_ids, yaw)
        self._yaw_before = self._yaw_before.index_copy(0, env_ids, yaw)
        self._travelled_w = self._travelled_w.index_fill(0, env_ids, 0.0)

    def advance(self, measured: Kinematics) -> None:
        """One control step."""
        self._yaw = measured.yaw
        self._travelled_w = self._travelled_w + rotate_yaw(measured.yaw, measured.base_lin_vel_yaw) * self._dt

    def since_last_frame(self, came: torch.Tensor | None = None) -> torch.Tensor:
        """Motion up to now since the last frame that came, in the levelled base of then.

        Args:
            came: (num_envs, 1) bool: whose frame comes now; None: all.

        Returns:
            (num_envs, 3) x, y (m) and yaw (rad); 0 where no frame comes, and the sum goes on.
        """
        turned = torch.remainder(self._yaw - self._yaw_before + torch.pi, 2 * torch.pi) - torch.pi
        moved = torch.cat((rotate_yaw(-self._yaw_before, self._travelled_w), turned[:, None]), 1)
        if came is None:
            self._yaw_before = self._yaw
            self._travelled_w = torch.zeros_like(self._travelled_w)
            return moved
        self._yaw_before = torch.where(came[:, 0], self._yaw, self._yaw_before)
        self._travelled_w = torch.where(came, 0.0, self._travelled_w)
        return torch.where(came, moved, 0.0)

    def state_dict(self) -> dict:
        return {"travelled": self._travelled_w, "yaw": self._yaw, "yaw_before": self._yaw_before}

    def load_state_dict(self, state: dict) -> None:
        self._travelled_w, self._yaw, self._yaw_before = state["travelled"], state["yaw"], state["yaw_before"]
