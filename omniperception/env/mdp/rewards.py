"""Reward terms, named for what they measure; the weight in the config carries the sign.

Every term is a function of the state and returns (num_envs,). Table 'Reward structure for Omni-Perception' of the paper
lists the eleven of `rewards=paper`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from omnilidar.launch import constant
from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.common.sectors import FAR
from omniperception.env.state import EnvState, requires, rests


@requires("avoidance")
def velocity_tracking_with_avoidance(state: EnvState, beta: float) -> torch.Tensor:
    """r_vel_avoid = exp(-beta_va |v - (v_cmd + V_avoid)|^2)."""
    target = state.reference[:, :2] + state.avoidance_velocity
    return torch.exp(-beta * (state.kinematics.base_lin_vel_yaw - target).square().sum(1))


def velocity_tracking(state: EnvState, beta: float) -> torch.Tensor:
    """exp(-beta |v_xy - v_ref|^2): tracking without obstacles, of `EnvState.reference`."""
    error = state.kinematics.base_lin_vel_yaw - state.reference[:, :2]
    return torch.exp(-beta * error.square().sum(1))


def yaw_rate_tracking(state: EnvState, beta: float) -> torch.Tensor:
    """exp(-beta (w_z - w_ref)^2); the paper commands a yaw rate and has no term for it."""
    error = state.kinematics.base_ang_vel_b[:, 2] - state.reference[:, 2]
    return torch.exp(-beta * error.square())


def progress(state: EnvState, enough: float = 1.0) -> torch.Tensor:
    """v_xy along v_ref, in units of `enough` and at most |v_ref|, m/s: below 0 for a robot that backs off, 0 where none
    is asked for. With an `enough` below 1 that share of the speed earns all, so that there is time to go round."""
    wanted = state.reference[:, :2]
    speed = wanted.norm(dim=1)
    along = (state.kinematics.base_lin_vel_yaw * wanted).sum(1) / speed.clamp(min=1e-6)
    return torch.minimum(along, enough * speed) / enough


def velocity_error(state: EnvState) -> torch.Tensor:
    """|v_xy - v_ref|, m/s: unlike `velocity_tracking` as steep far from the reference as near it."""
    return (state.kinematics.base_lin_vel_yaw - state.reference[:, :2]).norm(dim=1)


def yaw_rate_error(state: EnvState) -> torch.Tensor:
    """|w_z - w_ref|, rad/s."""
    return (state.kinematics.base_ang_vel_b[:, 2] - state.reference[:, 2]).abs()


@requires("distal_range")
def capped_ray_distance(state: EnvState, max_distance: float) -> torch.Tensor:
    """r_rays = sum_i min(d_i, d_max) / (n d_max) over the distal LiDAR rays; a miss counts as d_max."""
    return state.mean_distal_range(max_distance) / max_distance


def vertical_velocity_squared(state: EnvState) -> torch.Tensor:
    """v_z^2, (m/s)^2."""
    return state.kinematics.base_lin_vel_b[:, 2].square()


def roll_pitch_rate_squared(state: EnvState) -> torch.Tensor:
    """w_x^2 + w_y^2, (rad/s)^2."""
    return state.kinematics.base_ang_vel_b[:, :2].square().sum(1)


def tilt_squared(state: EnvState) -> torch.Tensor:
    """Squared horizontal part of projected gravity: 0 when level."""
    return state.kinematics.projected_gravity_b[:, :2].square().sum(1)


@requires("foot_force")
def foot_stumble(state: EnvState, ratio: float, unit: float, most: float = math.inf) -> torch.Tensor:
    """|F_xy|^2 of feet that stumble, in units of `unit` newtons, each at most (`most` newtons)^2.

    A foot stumbles when its horizontal force exceeds `ratio` times the vertical one, as against a vertical face;
    walking friction stays below the friction cone. `ratio` 0 counts every horizontal force.
    """
    force = state.foot_force / unit
    horizontal = force[..., :2].square().sum(-1)
    stumbles = horizontal > (ratio * force[..., 2]).square()
    return (horizontal.clamp(max=(most / unit) ** 2) * stumbles).sum(1)


@requires("link_force")
def link_collision(state: EnvState, unit: float, most: float = math.inf) -> torch.Tensor:
    """|F_xy|^2 of the penalised links, in units of `unit` newtons, each at most (`most` newtons)^2."""
    return (state.link_force[..., :2] / unit).square().sum(2).clamp(max=(most / unit) ** 2).sum(1)


@requires("obstacle_contact")
def obstacle_contact(state: EnvState) -> torch.Tensor:
    """1 while any link touches an obstacle."""
    return state.obstacle_contact.float()


@requires("obstacle_force")
def obstacle_impulse(state: EnvState, most: float = math.inf) -> torch.Tensor:
    """|Impulse| on obstacles in this control step, at most `most` (N s), by its duration: N. So its sum over an episode
    is what all touches came to in N s: a light touch costs little, a long one no more than what it pushes."""
    return state.obstacle_impulse.clamp(max=most) / state.control_dt


def closing_speed(state: EnvState, horizon: float, margin: float) -> torch.Tensor:
    """Imminence of the worst collision course, 0 to 1.

    For each obstacle, its distance from the robot at the closest approach within `horizon` (s) if both keep their
    velocities; the term is the largest (1 - clearance / margin) (1 - time / horizon) with clearance (m) to the
    obstacle's edge below `margin` (m). It sees the approach, where the sector distances see only the distance. The
    approach is to the middle of a round obstacle, and to the point of a rectangular one that is nearest now.
    """
    pos, vel, radius, active, axis, half_sides = state.obstacles
    if pos.shape[1] == 0:
        return torch.zeros(state.num_envs, device=state.device)
    rel_vel = vel - state.kinematics.base_lin_vel_yaw[:, None]
    is_round = half_sides[..., 1] < 0  # a point with a radius, then
    half_sides = half_sides.masked_fill(is_round[..., None], 0.0)
    aim = _nearest_point(pos, axis, half_sides)
    time = (-(aim * rel_vel).sum(-1) / rel_vel.square().sum(-1).clamp(min=1e-6)).clamp(0.0, horizon)
    nearest = _nearest_point(pos + rel_vel * time[..., None], axis, half_sides)
    clearance = nearest.norm(dim=-1) - radius * is_round
    danger = (1 - clearance.clamp(min=0.0) / margin).clamp(min=0.0) * (1 - time / horizon)
    return (danger * active).amax(1)


def _nearest_point(pos: torch.Tensor, axis: torch.Tensor, half_sides: torch.Tensor) -> torch.Tensor:
    """(n, O, 2) the point nearest to the origin of rectangles around `pos`, whose first sides are along `axis`."""
    across = torch.stack((-axis[..., 1], axis[..., 0]), -1)
    middle = torch.stack(((pos * axis).sum(-1), (pos * across).sum(-1)), -1)
    nearest = middle - middle.clamp(-half_sides, half_sides)
    return nearest[..., :1] * axis + nearest[..., 1:] * across


@requires("foot_force")
def foot_timing(
    state: EnvState, frequency: float, offsets: Sequence[float], duty: float, rest_s: float
) -> torch.Tensor:
    """Share of the feet that are down or up as a clock says; all should be down once the robot should rest.

    A foot should be down during the first `duty` of its period, which begins `offsets` of a period after the clock's,
    that of the observation `gait_phase` of the same `frequency` (Hz) and `rest_s`.
    """
    phase = frequency * state.time_s[:, None] - constant(tuple(offsets), state.device)
    down = torch.remainder(phase, 1.0) < duty
    down = down | rests(state, rest_s)[:, None]
    return (down == state.foot_contact).float().mean(1)


@requires("foot_force")
def foot_air_time(state: EnvState, target: float, min_speed: float) -> torch.Tensor:
    """Sum over feet that touch down of (air time - `target`) (s); 0 where the commanded velocity is below `min_speed`
    (m/s). Positive for steps longer than `target` (Rudin et al., 'Learning to Walk in Minutes', 2022)."""
    times = state.foot_times
    moving = state.command[:, :2].norm(dim=1) > min_speed
    return ((times.last_air - target) * times.touched_down).sum(1) * moving


@requires("legs")
def foot_clearance(state: EnvState, target: float) -> torch.Tensor:
    """Sum over feet of (height - `target`)^2 times horizontal speed, m^3/s: small where feet that move are lifted to
    `target` (m) above the ground below them."""
    return ((state.foot_height - target).square() * state.foot_vel_w[..., :2].norm(dim=-1)).sum(1)


@requires("foot_force")
def foot_slip(state: EnvState) -> torch.Tensor:
    """Sum over feet in contact of the squared horizontal speed, (m/s)^2."""
    return (state.foot_vel_w[..., :2].square().sum(-1) * state.foot_contact).sum(1)


@requires("legs")
def joint_limit_violation(state: EnvState) -> torch.Tensor:
    """Number of joints outside their position limits."""
    joint_pos = state.kinematics.joint_pos
    return ((joint_pos < state.joint_lower) | (joint_pos > state.joint_upper)).sum(1).float()


@requires("legs")
def joint_near_stop(state: EnvState, margin: float) -> torch.Tensor:
    """Sum over joints of how far (rad) they are within `margin` (rad) of the ends of their ranges, or beyond."""
    joint_pos = state.kinematics.joint_pos
    room = torch.minimum(joint_pos - state.joint_lower, state.joint_upper - joint_pos)
    return (margin - room).clamp(min=0.0).sum(1)


@requires("legs")
def joint_torque_near_limit(state: EnvState, share: float) -> torch.Tensor:
    """Sum over joints of how far their torque exceeds `share` of its limit, as a share of the limit."""
    return (state.joint_torque.abs() / state.joint_torque_limit - share).clamp(min=0.0).sum(1)


@requires("legs")
def standing_joint_velocity_squared(state: EnvState, rest_s: float) -> torch.Tensor:
    """|qdot|^2, (rad/s)^2, once the robot should rest; 0 otherwise."""
    return state.kinematics.joint_vel.square().sum(1) * rests(state, rest_s)


@requires("legs")
def joint_torque_squared(state: EnvState) -> torch.Tensor:
    """|tau|^2, (N m)^2."""
    return state.joint_torque.square().sum(1)


@requires("legs")
def joint_velocity_squared(state: EnvState) -> torch.Tensor:
    """|qdot|^2, (rad/s)^2."""
    return state.kinematics.joint_vel.square().sum(1)


@requires("legs")
def joint_acceleration_squared(state: EnvState) -> torch.Tensor:
    """|qddot|^2, (rad/s^2)^2, by the difference of joint velocities over the control step."""
    return state.joint_acc.square().sum(1)


def action_rate_squared(state: EnvState) -> torch.Tensor:
    """|a_{t-1} - a_t|^2."""
    return (state.actions[1] - state.actions[0]).square().sum(1)


def action_acceleration_squared(state: EnvState) -> torch.Tensor:
    """|a_{t-2} - 2 a_{t-1} + a_t|^2."""
    return (state.actions[2] - 2 * state.actions[1] + state.actions[0]).square().sum(1)


@requires("legs")
def default_pose_deviation(state: EnvState) -> torch.Tensor:
    """Squared distance (rad^2) of the joints from `EnvState.pose`, the default one where the robot does not step."""
    return (state.kinematics.joint_pos - state.pose).square().sum(1)


def alive(state: EnvState) -> torch.Tensor:
    """1 in every step."""
    return torch.ones(state.num_envs, device=state.device)


def deviation_while_free(state: EnvState, within: float) -> torch.Tensor:
    """|v - v_ref|^2, (m/s)^2 and (rad/s)^2, where no obstacle is nearer than `within` (m)."""
    free = (state.sectors[..., 0] > within).all(1)
    return (state.kinematics.planar_velocity - state.reference).square().sum(1) * free


def deviation(state: EnvState) -> torch.Tensor:
    """|v_xy - v_ref|^2, (m/s)^2, whatever is near."""
    return (state.kinematics.base_lin_vel_yaw - state.reference[:, :2]).square().sum(1)


def yaw_deviation(state: EnvState) -> torch.Tensor:
    """(w_z - w_ref)^2, (rad/s)^2."""
    return (state.kinematics.base_ang_vel_b[:, 2] - state.reference[:, 2]).square()


def time_to_collision(state: EnvState, radius: float, scale_s: float) -> torch.Tensor:
    """exp(-t / `scale_s`), t (s) until a disc of `radius` (m) meets the obstacle of a sector if both keep their
    velocities; 0 where it meets none."""
    sectors = state.sectors
    distance = sectors[..., 0].clamp(max=FAR)
    place = distance[..., None] * sector_bearings(sectors.shape[1], sectors.device)
    velocity = sectors[..., 1:] - state.kinematics.base_lin_vel_yaw[:, None]
    speed2 = velocity.square().sum(-1)
    closing = -(place * velocity).sum(-1)
    inside = closing.square() - speed2 * (distance.square() - radius**2)
    time = (closing - inside.clamp(min=0.0).sqrt()).clamp(min=0.0) / speed2.clamp(min=1e-6)
    meets = (inside > 0) & (closing > 0) & sectors[..., 0].isfinite()
    return torch.where(meets, torch.exp(-time / scale_s), 0.0).amax(1)


def nearness(state: EnvState, radius: float, within: float) -> torch.Tensor:
    """How near the nearest obstacle is: 1 at `radius` (m) from the base's origin, 0 from `within` (m) beyond it."""
    gap = state.sectors[..., 0].amin(1) - radius
    return (1 - gap / within).clamp(0.0, 1.0)


def standing_while_free(state: EnvState, share: float, free: float) -> torch.Tensor:
    """1 for a robot that is commanded to go, goes at less than `share` of that speed, and has a way: a sector within 60
    degrees of the command in which nothing is for `free` (m)."""
    wanted = state.reference[:, :2]
    speed = wanted.norm(dim=1)
    bearings = sector_bearings(state.sectors.shape[1], state.device)
    ahead = (wanted @ bearings.T) > 0.5 * speed[:, None]
    way = (ahead & (state.sectors[..., 0] > free)).any(1)
    slow = state.kinematics.base_lin_vel_yaw.norm(dim=1) < share * speed
    return (way & slow & (speed > 0.2)).float()


def fallen(state: EnvState, tilt_deg: float) -> torch.Tensor:
    """1 for a base that is inclined by more than `tilt_deg`."""
    upright = -state.kinematics.projected_gravity_b[:, 2]
    return (upright < math.cos(math.radians(tilt_deg))).float()


def asked_change_squared(state: EnvState) -> torch.Tensor:
    """|u_t - u_{t-1}|^2 of the velocities that are asked for, (m/s)^2, before the limit of their change."""
    return (state.targets[0] - state.targets[1])[:, :2].square().sum(1)


def asked_jump(state: EnvState, free: float) -> torch.Tensor:
    """(|u_t - u_{t-1}| - `free`)^2 beyond `free` (m/s) of the velocities that are asked for: jumps make robots fall."""
    change = (state.targets[0] - state.targets[1])[:, :2].norm(dim=1)
    return (change - free).clamp(min=0.0).square()


def asked_turn_squared(state: EnvState) -> torch.Tensor:
    """(w_t - w_{t-1})^2 of the yaw rates that are asked for, (rad/s)^2."""
    return (state.targets[0] - state.targets[1])[:, 2].square()
