"""Base and joints of all robots at one moment, in the frames that terms need."""

from __future__ import annotations

import torch

from omniperception.common.lazy import lazy
from omniperception.common.rotations import rotate_inverse, rotate_yaw, yaw_of


class Kinematics:
    """Base and joint state at one moment; float32, (num_envs, ...), copies of the simulator's own.

    Attributes:
        base_pos_w: (n, 3) m, environment frame.
        base_quat_w: (n, 4) wxyz.
        base_lin_vel_w: (n, 3) m/s, environment frame.
        base_ang_vel_b: (n, 3) rad/s, base frame.
        joint_pos: (n, num_joints) rad.
        joint_vel: (n, num_joints) rad/s.
    """

    def __init__(self, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        """From `Simulator.robot_state`: (n, 7 + joints) and (n, 6 + joints)."""
        qpos, qvel = self._state = qpos.float(), qvel.float()
        self.base_pos_w, self.base_quat_w, self.joint_pos = qpos[:, :3], qpos[:, 3:7], qpos[:, 7:]
        self.base_lin_vel_w, self.base_ang_vel_b, self.joint_vel = qvel[:, :3], qvel[:, 3:6], qvel[:, 6:]

    def replaced(self, which: torch.Tensor, by: Kinematics) -> Kinematics:
        """These, and in the rows that (n, 1) bool names the others."""
        return Kinematics(*(torch.where(which, new, own) for own, new in zip(self._state, by._state, strict=True)))

    @lazy
    def yaw(self) -> torch.Tensor:
        """(n,) rad: heading of the base."""
        return yaw_of(self.base_quat_w)

    @lazy
    def base_lin_vel_yaw(self) -> torch.Tensor:
        """(n, 2) m/s: horizontal velocity in the yaw-aligned frame."""
        return rotate_yaw(-self.yaw, self.base_lin_vel_w[:, :2])

    @lazy
    def planar_velocity(self) -> torch.Tensor:
        """(n, 3) v_x, v_y (m/s, yaw-aligned frame) and yaw rate (rad/s)."""
        return torch.cat((self.base_lin_vel_yaw, self.base_ang_vel_b[:, 2:]), 1)

    @property
    def base_lin_vel_b(self) -> torch.Tensor:
        """(n, 3) m/s: linear velocity in the base frame."""
        return self._in_base_frame[0]

    @property
    def projected_gravity_b(self) -> torch.Tensor:
        """(n, 3) unit vector of gravity in the base frame."""
        return self._in_base_frame[1]

    @lazy
    def _in_base_frame(self) -> torch.Tensor:
        """(2, n, 3) linear velocity and gravity, in one rotation."""
        down = torch.zeros_like(self.base_lin_vel_w)
        down[:, 2] = -1.0
        vectors = torch.cat((self.base_lin_vel_w, down))
        return rotate_inverse(self.base_quat_w.repeat(2, 1), vectors).unflatten(0, (2, -1))
