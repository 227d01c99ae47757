"""What a navigation policy reads: a choice of velocity without learning, what is around, and how the robot moves."""

from __future__ import annotations

import torch

from omniperception.avoidance.sector_motion import NEARNESS_RANGE, sector_bearings
from omniperception.avoidance.velocity_risk import VelocityRisk

NUM_SECTORS = 36
"""Azimuth sectors that a navigation policy reads."""
CLOSE = 0.4
"""Decay (m) of the second number of a sector's distance, which resolves what is close."""
SPEED = 1.5
"""Obstacles' velocities are divided by it (m/s)."""
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


BARRIER_PASSES = 4
"""Projections of a velocity onto what a barrier allows, each for the sector that it violates most."""


def within_barrier(velocity: torch.Tensor, inputs: torch.Tensor, rate: float, radius: float) -> torch.Tensor:
    """Velocities whose approach to no obstacle is faster than a control barrier allows.

    With the gap h = d - `radius` to the obstacle of a sector, h' >= -`rate` h: the velocity along the sector's bearing
    is at most `rate` h plus the obstacle's own. Of a single obstacle the nearest such velocity, in closed form; of
    several one that is found by BARRIER_PASSES projections, as far as there is one.

    Args:
        velocity: (n, 3) v_x, v_y (m/s) and yaw rate, which stays, in the yaw-aligned frame.
        inputs: (n, D) `navigation_inputs`, from which the sectors are read, out to NEARNESS_RANGE.
        rate: 1/s.
        radius: m, from the base's origin.

    Returns:
        (n, 3).
    """
    bearings = sector_bearings(NUM_SECTORS, inputs.device)  # (S, 2)
    nearness, moving = inputs[:, 3 : 3 + NUM_SECTORS], inputs[:, 3 + 2 * NUM_SECTORS : 3 + 4 * NUM_SECTORS]
    own = SPEED * (moving.unflatten(1, (NUM_SECTORS, 2)) * bearings).sum(-1)
    most = rate * (NEARNESS_RANGE * (1.0 - nearness) - radius) + own
    most = torch.where(nearness > 0, most, torch.inf)
    planar = velocity[:, :2]
    for _ in range(BARRIER_PASSES):
        excess, sector = (planar @ bearings.T - most).max(1)
        planar = planar - excess.clamp(min=0.0)[:, None] * bearings[sector]
    return torch.cat((planar, velocity[:, 2:]), 1)
