"""Directions that a robot's LiDAR has looked into: `omniperception.avoidance.coverage` in NumPy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from omnirobot.common.coverage import BIN_DEG, FRAMES, NUM_BINS, NUM_SECTORS, OPEN_DEG, SHUT_DEG
from omnirobot.runtime.geometry import sector_of
from omnirobot.runtime.sampling import Attitude, is_hit, rotation_matrix, without_heading

_ANGLES = -math.pi + 2.0 * math.pi / NUM_SECTORS * (np.arange(NUM_SECTORS) + 0.5)
_BEARINGS = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), 1)
_NAMES = ("ahead", "ahead left", "left", "behind left", "behind", "behind right", "right", "ahead right")


class Coverage:
    """Which sectors the newest frames cover.

    Attributes:
        covered: (NUM_SECTORS,) bool; everywhere before the first frame.
    """

    def __init__(self, least_bins: Sequence[int], max_range: float) -> None:
        """Args: least_bins: of a covered sector, as `description.Lidar` has them; max_range: m."""
        self._least, self._max_range = np.asarray(least_bins), max_range
        self.reset()

    def reset(self) -> None:
        """As at the start of an episode."""
        self._answered = np.ones((FRAMES, NUM_SECTORS, NUM_BINS), bool)
        self.covered = np.ones(NUM_SECTORS, bool)

    def add_frame(self, points: np.ndarray, attitude: Attitude) -> None:
        """Takes in a frame (n, 3), m, sensor frame; rows that are zero, too far or not finite are no answers."""
        points = points[is_hit(points, self._max_range)]
        level = without_heading(rotation_matrix(attitude.base_quat)) @ rotation_matrix(attitude.mount_quat)
        places = points @ level.T.astype(np.float32)
        elevation = np.degrees(np.arcsin(np.clip(places[:, 2] / np.linalg.norm(points, axis=1), -1.0, 1.0))) + 90.0
        found = np.zeros((NUM_SECTORS, NUM_BINS), bool)
        found[sector_of(places[:, :2], NUM_SECTORS), np.minimum(elevation // BIN_DEG, NUM_BINS - 1).astype(int)] = True
        self._append(found)

    def repeat_frame(self) -> None:
        """Takes in that a frame was due and did not come."""
        self._append(np.zeros((NUM_SECTORS, NUM_BINS), bool))

    def _append(self, found: np.ndarray) -> None:
        self._answered = np.concatenate((self._answered[1:], found[None]))
        self.covered = self._answered.any(0).sum(1) >= self._least

    def kept_to_covered(self, velocity: np.ndarray) -> np.ndarray:
        """(2,) m/s: a velocity (2,) in the base frame, slowed down where it leads into sectors that are not covered."""
        if self.covered.all():
            return velocity
        speed = max(float(np.hypot(*velocity)), 1e-6)
        towards = float((_BEARINGS[~self.covered] @ velocity).max()) / speed
        shut, free = math.cos(math.radians(SHUT_DEG)), math.cos(math.radians(OPEN_DEG))
        return velocity * np.float32(np.clip((shut - towards) / (shut - free), 0.0, 1.0))

    def lacking(self) -> str:
        """Where nobody looked, in words."""
        eighth = np.round(_ANGLES[~self.covered] / (math.pi / 4.0)).astype(int) % 8
        where = ", ".join(_NAMES[k] for k in sorted(set(eighth.tolist())))
        return f"{len(eighth)} of {NUM_SECTORS} directions ({where if len(set(eighth)) < 8 else 'all around'})"
