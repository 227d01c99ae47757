"""Motion of the base since the last LiDAR frame, from its estimated velocity and the IMU's heading."""

from __future__ import annotations

from collections import deque

import numpy as np

from omnirobot.runtime.sampling import rotation_matrix

OLDEST_S = 0.3
"""Age (s) of a frame beyond which it is taken as that old."""


class Odometry:
    """Adds up the velocity from one frame to the next; the first state is where it starts."""

    def __init__(self, control_period_s: float) -> None:
        self._dt = control_period_s
        self._travelled_w = np.zeros(2)
        self._yaw: float | None = None
        self._yaw_before = 0.0

    def advance(self, base_quat: np.ndarray, base_lin_vel: np.ndarray) -> None:
        """Args: base_quat: (4,) unit, (w, x, y, z); base_lin_vel: (3,) m/s in the base frame."""
        axes, yaw = level_axes(base_quat)
        if self._yaw is None:
            self._yaw_before = yaw
        else:
            self._travelled_w = self._travelled_w + axes @ np.asarray(base_lin_vel, np.float64) * self._dt
        self._yaw = yaw

    def since_last_frame(self) -> np.ndarray:
        """(3,) x, y (m) and yaw (rad) since the call before, in the levelled base of then."""
        yaw = self._yaw_before if self._yaw is None else self._yaw
        moved = _seen_from(np.array([0.0, 0.0, self._yaw_before]), np.array([*self._travelled_w, yaw]))
        self._travelled_w, self._yaw_before = np.zeros(2), yaw
        return moved.astype(np.float32)


class TimedOdometry:
    """As `Odometry`, for frames whose age is known: where the base was when they were taken, and how it was turned."""

    num_rows = 3

    def __init__(self, control_period_s: float) -> None:
        self._dt = control_period_s
        self._steps: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=round(OLDEST_S / control_period_s) + 1)
        self._place = np.zeros(2)
        self._taken: np.ndarray | None = None
        self._age = 0.0

    def advance(self, base_quat: np.ndarray, base_lin_vel: np.ndarray) -> None:
        """Args: base_quat: (4,) unit, (w, x, y, z); base_lin_vel: (3,) m/s in the base frame."""
        axes, yaw = level_axes(base_quat)
        if self._steps:
            self._place = self._place + axes @ np.asarray(base_lin_vel, np.float64) * self._dt
            self._age += self._dt
        self._steps.append((np.array([*self._place, yaw]), np.asarray(base_quat, np.float64)))

    def attitude(self, age_s: float) -> np.ndarray:
        """(4,) orientation of the base `age_s` ago, in the nearest control step that is kept."""
        return self._at(age_s)[1]

    def take(self, age_s: float | None) -> np.ndarray:
        """(3, 3) the last rows of a frame that was taken `age_s` ago, or of the last one again where none comes.

        How the base moved from where the frame before was taken to where this one was, and from there to now (x, y in
        m, yaw in rad, in the levelled base of then); age, time since the frame before (s), and 0.
        """
        here = self._at(0.0)[0]
        moved, between = np.zeros(3), 0.0
        if age_s is not None:
            taken = self._at(age_s)[0]
            if self._taken is not None:
                moved, between = _seen_from(self._taken, taken), self._age - age_s
            self._taken, self._age = taken, age_s
        since = np.zeros(3) if self._taken is None else _seen_from(self._taken, here)
        return np.array([moved, since, (self._age, between, 0.0)], np.float32)

    def _at(self, age_s: float) -> tuple[np.ndarray, np.ndarray]:
        back = min(round(age_s / self._dt), len(self._steps) - 1)
        return self._steps[-1 - back]


def level_axes(base_quat: np.ndarray) -> tuple[np.ndarray, float]:
    """(2, 3) horizontal parts of the base's axes in the world, and its heading (rad)."""
    axes = rotation_matrix(base_quat)[:2]
    return axes, float(np.arctan2(axes[1, 0], axes[0, 0]))


def _seen_from(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(3,) motion from one pose to another, in the levelled base of the first."""
    cos, sin = np.cos(start[2]), np.sin(start[2])
    dx, dy = end[:2] - start[:2]
    turned = np.remainder(end[2] - start[2] + np.pi, 2 * np.pi) - np.pi
    return np.array([cos * dx + sin * dy, -sin * dx + cos * dy, turned])
