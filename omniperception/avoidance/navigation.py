"""What a navigation policy reads: a choice of velocity without learning, what is around, and how the robot moves."""

from __future__ import annotations

import torch

from omniperception.avoidance.sector_motion import NEARNESS_RANGE
from omniperception.avoidance.velocity_risk import VelocityRisk

NUM_SECTORS = 36
"""Azimuth sectors that a navigation policy reads."""
CLOSE = 0.4
"""Decay (m) of the second number of a sector's distance, which resolves what is close."""
SPEED = 1.5
"""Obstacles' velocities are divided by it (m/s)."""
NEARNESS = slice(3, 3 + NUM_SECTORS)
"""Where in `navigation_inputs` the nearness of the sectors is, behind the choice and the commanded yaw rate."""
OWN_MOTION = 9
"""Numbers of the robot's own motion: reference, velocity and asked velocity, three each."""


def num_inputs(risk: VelocityRisk) -> int:
    """How many numbers `navigation_inputs` gives of NUM_SECTORS sectors."""
    return 3 + 4 * NUM_SECTORS + OWN_MOTION + risk.num_candidates


def navigation_inputs(
    sectors: torch.Tensor,
    reference: torch.Tensor,
    velocity: torch.Tensor,
    asked: torch.Tensor,
    risk: VelocityRisk,
    candidates: torch.Tensor,
    risks: torch.Tensor | None = None,
) -> torch.Tensor:
    """Inputs of a navigation policy, in the yaw-aligned frame.

    Args:
        sectors: (n, S, 3) distance (m, infinite without an obstacle) and velocity (m/s) by azimuth sector.
        reference: (n, 3) commanded v_x, v_y (m/s) and yaw rate (rad/s).
        velocity: (n, 3) the robot's own, as measured.
        asked: (n, 3) what its gait is asked for at present.
        risk: the controller whose choice comes first.
        candidates: its (K, 2) candidates.
        risks: (n, K) of the candidates, where they are known otherwise; None: they follow from the sectors.

    Returns:
        (n, 3 + 4 S + 9 + K): the velocity that the controller chooses, with the commanded yaw rate; nearness,
        closeness and velocity by sector; `reference`, `velocity` and `asked`; the risks of the candidates.
    """
    distance = sectors[..., 0]
    nearness = (1 - distance / NEARNESS_RANGE).clamp(min=0.0)
    closeness = torch.exp(-(distance - risk.robot_radius).clamp(min=0.0) / CLOSE)
    moving = sectors[..., 1:] * ((nearness > 0) / SPEED)[..., None]
    risks = risk.risk(sectors, candidates) if risks is None else risks
    chosen = reference[:, :2] + risk.avoidance(risks, reference[:, :2], candidates)
    parts = (chosen, reference[:, 2:], nearness, closeness, moving.flatten(1), reference, velocity, asked, risks)
    return torch.cat(parts, 1)
