"""The avoidance velocity of the paper, its settings, and the names of what a network is supervised with."""

from __future__ import annotations

import torch

from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.common.checked import AtLeastOne, Positive, checked

SECTOR_TARGET, AVOIDANCE_TARGET, MOTION_TARGET = "sector_target", "avoidance_target", "motion_target"
"""Supervision of a network: 1 - d / NEARNESS_RANGE by sector of what the LiDAR hits; the avoidance velocity; nearness
and velocity of the true obstacles by sector."""

COMMAND = "command"
"""Group of observations that begins with the commanded velocity (v_x, v_y), m/s."""
LAST_ASKED = "last_asked"
"""Observations (n, 2) of the velocity (m/s) that a policy asked its gait for in the step that ended."""


@checked("rewards.avoidance")
class AvoidanceConfig:
    """Avoidance velocity of the paper's section 'Risk-Aware Locomotion Policy'.

    Attributes:
        num_sectors: angular sectors around the robot.
        threshold: sectors with an obstacle nearer than this (m) push.
        alpha: decay (1/m) of the push with distance.
        max_speed: bound (m/s) of the sum's magnitude; None leaves it as the paper has it.
        max_acceleration: at most as fast (m/s^2) changes V_cmd + V_avoid where a policy adds V_avoid to the command, as
            gaits are trained with commands that do not jump (`observations.command_acceleration`); None: it jumps. The
            reward's V_avoid has no such limit.
        risk: None: V_avoid is the paper's sum; otherwise it follows from the risk of velocities, and the sectors only
            tell whether an obstacle is near.
    """

    num_sectors: AtLeastOne
    threshold: Positive
    alpha: Positive
    max_speed: Positive | None = None
    max_acceleration: Positive | None = None
    risk: VelocityRisk | None = None


def avoidance_velocity(distance: torch.Tensor, config: AvoidanceConfig) -> torch.Tensor:
    """V_avoid = sum over sectors nearer than the threshold of exp(-d alpha), away from the sector.

    Args:
        distance: (n, num_sectors) horizontal distance (m) to the nearest obstacle hit in each sector.

    Returns:
        (n, 2) m/s in the yaw-aligned frame.
    """
    push = torch.exp(-config.alpha * distance) * (distance < config.threshold)
    velocity = -push @ sector_bearings(distance.shape[1], distance.device)
    if config.max_speed is not None:
        speed = velocity.norm(dim=1, keepdim=True)
        velocity = velocity * (config.max_speed / speed.clamp(min=config.max_speed))
    return velocity
