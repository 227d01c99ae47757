"""Motion of the base since the last LiDAR frame, from its estimated velocity and the IMU's heading."""

from __future__ import annotations

import numpy as np


class Odometry:
    """Adds up the velocity from one frame to the next; the first state is where it starts."""

    def __init__(self, control_period_s: float) -> None:
        self._dt = control_period_s
        self._travelled_w = np.zeros(2)
        self._yaw: float | None = None
        self._yaw_before = 0.0

    def advance(self, base_quat: np.ndarray, base_lin_vel: np.ndarray) -> None:
        """Args: base_quat: (4,) unit, (w, x, y, z); base_lin_vel: (3,) m/s in the base frame."""
        w, x, y, z = base_quat
        forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)])
        sideways = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z)])
        upwards = np.array([2 * (x * z + w * y), 2 * (y * z - w * x)])
        yaw = float(np.arctan2(forward[1], forward[0]))
        if self._yaw is None:
            self._yaw_before = yaw
        else:
            vx, vy, vz = np.asarray(base_lin_vel, np.float64)
            self._travelled_w = self._travelled_w + (vx * forward + vy * sideways + vz * upwards) * self._dt
        self._yaw = yaw

    def since_last_frame(self) -> np.ndarray:
        """(3,) x, y (m) and yaw (rad) since the call before, in the levelled base of then."""
        cos, sin = np.cos(self._yaw_before), np.sin(self._yaw_before)
        dx, dy = self._travelled_w
        yaw = self._yaw_before if self._yaw is None else self._yaw
        turned = np.remainder(yaw - self._yaw_before + np.pi, 2 * np.pi) - np.pi
        self._travelled_w, self._yaw_before = np.zeros(2), yaw
        return np.array([cos * dx + sin * dy, -sin * dx + cos * dy, turned], np.float32)
