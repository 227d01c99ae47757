"""Reward terms, named for what they measure; the weight in the config carries the sign.

Every term is a function of the environment and returns (num_envs,). Table 'Reward structure for Omni-Perception' of the
paper lists the eleven of `rewards=paper`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.env.state import plain, reads

if TYPE_CHECKING:
    from omniperception.env.env import OmniEnv


@dataclass(frozen=True)
class AvoidanceConfig:
    """Avoidance velocity of the paper's section 'Risk-Aware Locomotion Policy'.

    Attributes:
        num_sectors: angular sectors around the robot.
        threshold: sectors with an obstacle nearer than this (m) push.
        alpha: decay (1/m) of the push with distance.
        max_speed: bound (m/s) of the sum's magnitude; None leaves it as the paper has it.
        risk: None: V_avoid is the paper's sum; otherwise it follows from the risk of velocities, and the sectors only
            tell whether an obstacle is near.
    """

    num_sectors: int
    threshold: float
    alpha: float
    max_speed: float | None = None
    risk: VelocityRisk | None = None

    def __post_init__(self) -> None:
        for key in ("num_sectors", "threshold", "alpha"):
            if getattr(self, key) <= 0:
                raise ValueError(f"rewards.avoidance.{key}={getattr(self, key)} must be positive")
        if self.max_speed is not None and self.max_speed <= 0:
            raise ValueError(f"rewards.avoidance.max_speed={self.max_speed} must be positive or null")


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


@reads("sectors")
def velocity_tracking_with_avoidance(env: OmniEnv, beta: float) -> torch.Tensor:
    """r_vel_avoid = exp(-beta_va |v - (v_cmd + V_avoid)|^2)."""
    target = env.command.value[:, :2] + env.avoidance_velocity
    return torch.exp(-beta * (env.kinematics.base_lin_vel_yaw - target).square().sum(1))


def velocity_tracking(env: OmniEnv, beta: float) -> torch.Tensor:
    """exp(-beta |v_xy - v_cmd|^2): tracking without obstacles."""
    error = env.kinematics.base_lin_vel_yaw - env.command.value[:, :2]
    return torch.exp(-beta * error.square().sum(1))


def yaw_rate_tracking(env: OmniEnv, beta: float) -> torch.Tensor:
    """exp(-beta (w_z - w_cmd)^2); the paper commands a yaw rate and has no term for it."""
    error = env.kinematics.base_ang_vel_b[:, 2] - env.command.value[:, 2]
    return torch.exp(-beta * error.square())


@reads("rays")
def capped_ray_distance(env: OmniEnv, max_distance: float) -> torch.Tensor:
    """r_rays = sum_i min(d_i, d_max) / (n d_max) over the distal LiDAR rays; a miss counts as d_max."""
    return env.sensing.mean_distal_range(max_distance) / max_distance


def distal_caps(terms: Iterable[Callable]) -> tuple[float, ...]:
    """The distances (m) at which `capped_ray_distance` caps ranges wherever it is one of the terms."""
    capped = (term for term in terms if plain(term) is capped_ray_distance)
    return tuple(sorted({float(term.keywords["max_distance"]) for term in capped}))


def vertical_velocity_squared(env: OmniEnv) -> torch.Tensor:
    """v_z^2, (m/s)^2."""
    return env.kinematics.base_lin_vel_b[:, 2].square()


def roll_pitch_rate_squared(env: OmniEnv) -> torch.Tensor:
    """w_x^2 + w_y^2, (rad/s)^2."""
    return env.kinematics.base_ang_vel_b[:, :2].square().sum(1)


def tilt_squared(env: OmniEnv) -> torch.Tensor:
    """Squared horizontal part of projected gravity: 0 when level."""
    return env.kinematics.projected_gravity_b[:, :2].square().sum(1)


@reads("foot_force")
def foot_stumble(env: OmniEnv, ratio: float, unit: float) -> torch.Tensor:
    """|F_xy|^2 of feet that stumble, in units of `unit` newtons.

    A foot stumbles when its horizontal force exceeds `ratio` times the vertical one, as against a vertical face;
    walking friction stays below the friction cone. `ratio` 0 counts every horizontal force.
    """
    force = env.foot_force / unit
    horizontal = force[..., :2].square().sum(-1)
    stumbles = horizontal > (ratio * force[..., 2]).square()
    return (horizontal * stumbles).sum(1)


@reads("link_force")
def link_collision(env: OmniEnv, unit: float) -> torch.Tensor:
    """|F_xy|^2 of the penalised links, in units of `unit` newtons."""
    return (env.link_force[..., :2] / unit).square().sum((1, 2))


@reads("obstacle_contact")
def obstacle_contact(env: OmniEnv) -> torch.Tensor:
    """1 while any link touches an obstacle."""
    return env.touching.float()


@reads("obstacles")
def closing_speed(env: OmniEnv, horizon: float, margin: float) -> torch.Tensor:
    """How imminent the worst collision course is, 0 to 1.

    For each obstacle, its distance from the robot at the closest approach within `horizon` (s) if both keep their
    velocities; the term is the largest (1 - clearance / margin) (1 - time / horizon) with clearance (m) to the
    obstacle's edge below `margin` (m). It sees the approach, where the sector distances see only the distance.
    """
    rel_pos, rel_vel = (
        env.obstacle_rel_pos_yaw,
        env.obstacle_vel_yaw - env.kinematics.base_lin_vel_yaw[:, None],
    )
    speed_squared = rel_vel.square().sum(-1)
    time = (-(rel_pos * rel_vel).sum(-1) / speed_squared.clamp(min=1e-6)).clamp(0.0, horizon)
    closest = (rel_pos + rel_vel * time[..., None]).norm(dim=-1) - env.obstacle_radius
    danger = (1 - closest.clamp(min=0.0) / margin).clamp(min=0.0) * (1 - time / horizon)
    return (danger * env.obstacle_active).amax(1)


def joint_limit_violation(env: OmniEnv) -> torch.Tensor:
    """Number of joints outside their position limits."""
    joint_pos = env.kinematics.joint_pos
    return ((joint_pos < env.joint_lower) | (joint_pos > env.joint_upper)).sum(1).float()


@reads("joint_torque")
def joint_torque_squared(env: OmniEnv) -> torch.Tensor:
    """|tau|^2, (N m)^2."""
    return env.joint_torque.square().sum(1)


def joint_velocity_squared(env: OmniEnv) -> torch.Tensor:
    """|qdot|^2, (rad/s)^2."""
    return env.kinematics.joint_vel.square().sum(1)


@reads("last_joint_vel")
def joint_acceleration_squared(env: OmniEnv) -> torch.Tensor:
    """|qddot|^2, (rad/s^2)^2, by the difference of joint velocities over the control step."""
    return ((env.kinematics.joint_vel - env.last_joint_vel) / env.control_dt).square().sum(1)


@reads("last_action")
def action_rate_squared(env: OmniEnv) -> torch.Tensor:
    """|a_{t-1} - a_t|^2."""
    return (env.actions[1] - env.actions[0]).square().sum(1)


@reads("last_action", "action_before_last")
def action_acceleration_squared(env: OmniEnv) -> torch.Tensor:
    """|a_{t-2} - 2 a_{t-1} + a_t|^2."""
    return (env.actions[2] - 2 * env.actions[1] + env.actions[0]).square().sum(1)


def default_pose_deviation(env: OmniEnv) -> torch.Tensor:
    """Squared distance (rad^2) of the joints from the default pose."""
    return (env.kinematics.joint_pos - env.default_joint_pos).square().sum(1)


def alive(env: OmniEnv) -> torch.Tensor:
    """1 in every step."""
    return torch.ones(env.num_envs, device=env.device)
