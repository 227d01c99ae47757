"""When an episode ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from omniperception.env.kinematics import Kinematics


@dataclass(frozen=True)
class TerminationsConfig:
    """Ends of an episode besides the time limit, a reached goal and diverged physics.

    Attributes:
        episode_length_s: time limit (s); reaching it is a time-out, not a failure.
        min_base_height: a base origin lower than this (m) above the ground is a fall.
        max_tilt_deg: a base inclined by more than this (deg) is a fall.
        on_collision: whether touching an obstacle ends the episode; the paper's collisions do not.
    """

    episode_length_s: float
    min_base_height: float
    max_tilt_deg: float
    on_collision: bool

    def __post_init__(self) -> None:
        if self.episode_length_s <= 0:
            raise ValueError(f"terminations.episode_length_s={self.episode_length_s} must be positive")
        if self.min_base_height < 0:
            raise ValueError(f"terminations.min_base_height={self.min_base_height} must not be negative")
        if not 0 < self.max_tilt_deg <= 180:
            raise ValueError(f"terminations.max_tilt_deg={self.max_tilt_deg} must lie in (0, 180]")

    def fallen(self, kinematics: Kinematics, base_height: torch.Tensor) -> torch.Tensor:
        """(num_envs,) bool: the base lies too low, `base_height` (num_envs,) (m), or is inclined too far."""
        upright = -kinematics.projected_gravity_b[:, 2]
        low = base_height < self.min_base_height
        return low | (upright < math.cos(math.radians(self.max_tilt_deg)))
