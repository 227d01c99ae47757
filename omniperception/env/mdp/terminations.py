"""When an episode ends."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from pydantic import Field

from omniperception.common.checked import NonNegative, Positive, checked
from omniperception.env.kinematics import Kinematics

_Tilt = Annotated[float, Field(gt=0, le=180), "in (0, 180]"]


@checked("terminations")
class TerminationsConfig:
    """Ends of an episode besides the time limit, a reached goal and diverged physics.

    Attributes:
        episode_length_s: time limit (s); reaching it is a time-out, not a failure.
        min_base_height: a base origin lower than this (m) above the ground is a fall.
        max_tilt_deg: a base inclined by more than this (deg) is a fall.
        on_collision: whether touching an obstacle ends the episode; the paper's collisions do not.
    """

    episode_length_s: Positive
    min_base_height: NonNegative
    max_tilt_deg: _Tilt
    on_collision: bool

    def fallen(self, kinematics: Kinematics, base_height: torch.Tensor) -> torch.Tensor:
        """(num_envs,) bool: the base lies too low, `base_height` (num_envs,) (m), or is inclined too far."""
        upright = -kinematics.projected_gravity_b[:, 2]
        low = base_height < self.min_base_height
        return low | (upright < math.cos(math.radians(self.max_tilt_deg)))
