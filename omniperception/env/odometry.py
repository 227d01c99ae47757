"""Motion of the base since the last LiDAR frame, as a state estimator measures it."""

from __future__ import annotations

import torch

from omniperception.common.rotations import rotate_yaw
from omniperception.common.stateful import Stateful
from omniperception.env.kinematics import Kinematics


class Odometry(Stateful):
    """Adds up the measured velocity from one frame to the next; the heading is the IMU's.

    Attributes:
        num_rows: rows of a frame that say how the base moved.
    """

    num_rows = 1
    saved = ("_travelled_w", "_yaw", "_yaw_before")

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

    def take(self, came: torch.Tensor, late_steps: torch.Tensor | None = None) -> torch.Tensor:
        """The row of the newest frame.

        Args:
            came: (num_envs,) bool: whose frame comes now.
            late_steps: not looked at: frames that bear no time count as taken when they come.

        Returns:
            (num_envs, 1, 3): motion up to now since the last frame that came, x, y (m) and yaw (rad), in the levelled
            base of then; 0 where no frame comes, and the sum goes on.
        """
        turned = torch.remainder(self._yaw - self._yaw_before + torch.pi, 2 * torch.pi) - torch.pi
        moved = torch.cat((rotate_yaw(-self._yaw_before, self._travelled_w), turned[:, None]), 1)
        self._yaw_before = torch.where(came, self._yaw, self._yaw_before)
        self._travelled_w = torch.where(came[:, None], 0.0, self._travelled_w)
        return torch.where(came[:, None], moved, 0.0)[:, None]


class TimedOdometry(Stateful):
    """As `Odometry`, for frames that bear the time at which they were taken.

    Attributes:
        num_rows: rows of a frame that say when and from where it was taken.
    """

    num_rows = 3
    saved = ("_newest", "_pose", "_quat", "_taken", "_age", "_has_frame")

    def __init__(self, num_envs: int, control_dt: float, max_late_steps: int, device: torch.device) -> None:
        """Args: max_late_steps: control steps by which a frame may be older than the moment it comes."""
        self._dt, self._all_envs = control_dt, torch.arange(num_envs, device=device)
        self._pose = torch.zeros(max_late_steps + 1, num_envs, 3, device=device)  # a ring: x, y (m), heading (rad)
        self._quat = torch.zeros(max_late_steps + 1, num_envs, 4, device=device)
        self._newest = 0
        self._taken = torch.zeros(num_envs, 3, device=device)
        self._age = torch.zeros(num_envs, device=device)
        self._has_frame = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def start(self, env_ids: torch.Tensor, measured: Kinematics) -> None:
        """The robots of some environments (n,) stand elsewhere; `measured` of all."""
        pose = torch.zeros(len(env_ids), 3, device=self._pose.device)
        pose[:, 2] = measured.yaw[env_ids]
        self._pose[:, env_ids], self._quat[:, env_ids] = pose, measured.base_quat_w[env_ids]
        self._taken[env_ids], self._age[env_ids], self._has_frame[env_ids] = pose, 0.0, False

    def advance(self, measured: Kinematics) -> None:
        """One control step."""
        place = self._pose[self._newest, :, :2] + rotate_yaw(measured.yaw, measured.base_lin_vel_yaw) * self._dt
        self._newest = (self._newest + 1) % len(self._pose)
        self._pose[self._newest] = torch.cat((place, measured.yaw[:, None]), 1)
        self._quat[self._newest] = measured.base_quat_w
        self._age += self._dt

    def attitude(self, late_steps: torch.Tensor | None) -> torch.Tensor:
        """(num_envs, 4) measured orientation of the base when a frame was taken, (num_envs,) control steps ago."""
        return self._quat[self._newest] if late_steps is None else self._quat[self._at(late_steps), self._all_envs]

    def take(self, came: torch.Tensor, late_steps: torch.Tensor | None = None) -> torch.Tensor:
        """Rows of the newest frame.

        Args:
            came: (num_envs,) bool: whose frame comes now.
            late_steps: (num_envs,) control steps ago it was taken; None: now.

        Returns:
            (num_envs, 3, 3): how the base moved (x, y in m, yaw in rad) from where the frame before was taken to where
            this one was, in the levelled base of then; from there to now, likewise; and the age of this frame, the time
            from the one before to it (s), and 0. Where no frame comes, those of the last one that came: no motion and
            no time, and all that it is older. The first frame follows none.
        """
        here = self._pose[self._newest]
        late = torch.zeros_like(self._age) if late_steps is None else late_steps * self._dt
        taken = here if late_steps is None else self._pose[self._at(late_steps), self._all_envs]
        between = self._age - late
        follows, self._has_frame = came & self._has_frame, came | self._has_frame
        moved = _seen_from(self._taken, taken) * follows[:, None]
        self._taken, self._age = torch.where(came[:, None], taken, self._taken), torch.where(came, late, self._age)
        times = torch.stack((self._age, between * follows, torch.zeros_like(between)), 1)
        return torch.stack((moved, _seen_from(self._taken, here), times), 1)

    def _at(self, late_steps: torch.Tensor) -> torch.Tensor:
        return torch.remainder(self._newest - late_steps, len(self._pose))


def _seen_from(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """(n, 3) motion from one pose to another (n, 3), in the levelled base of the first."""
    turned = torch.remainder(end[:, 2:] - start[:, 2:] + torch.pi, 2 * torch.pi) - torch.pi
    return torch.cat((rotate_yaw(-start[:, 2], end[:, :2] - start[:, :2]), turned), 1)
