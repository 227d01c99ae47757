"""Observation terms: functions of the state that return (num_envs, width), and how each looks in the mirror."""

from __future__ import annotations

import torch

from omniperception.env.mdp.terms import JOINT_MAGNITUDES, JOINTS, ROTATION, VECTOR, mirrors
from omniperception.env.state import EnvState, requires, rests


@mirrors(JOINTS)
def joint_pos_offset(state: EnvState) -> torch.Tensor:
    """Joint position relative to the default pose, rad, as measured (with latency when randomized)."""
    return state.measured.joint_pos - state.default_joint_pos


@mirrors(JOINTS)
def joint_vel(state: EnvState, scale: float = 1.0) -> torch.Tensor:
    """Joint velocity, rad/s, times `scale`, as measured."""
    return state.measured.joint_vel * scale


@mirrors(VECTOR)
def base_lin_vel(state: EnvState) -> torch.Tensor:
    """Base linear velocity in the base frame, m/s, as measured."""
    return state.measured.base_lin_vel_b


@mirrors(ROTATION)
def base_ang_vel(state: EnvState, scale: float = 1.0) -> torch.Tensor:
    """Base angular velocity in the base frame, rad/s, times `scale`, as measured."""
    return state.measured.base_ang_vel_b * scale


@mirrors(VECTOR)
def projected_gravity(state: EnvState) -> torch.Tensor:
    """Unit vector of gravity in the base frame, as measured."""
    return state.measured.projected_gravity_b


@mirrors((1.0, -1.0, -1.0))
def command(state: EnvState) -> torch.Tensor:
    """v_x, v_y (m/s) and yaw rate (rad/s) in the base frame: `EnvState.reference`."""
    return state.reference


@mirrors(JOINTS)
def previous_action(state: EnvState) -> torch.Tensor:
    """The action applied in the step that ended."""
    return state.actions[0]


@mirrors((-1.0, -1.0))
def gait_phase(state: EnvState, frequency: float, rest_s: float) -> torch.Tensor:
    """Sine and cosine of a clock of `frequency` (Hz) that starts with the episode; 0 once the robot should rest.

    It should rest while the command is to stand, and has been for `rest_s` (s): whoever runs has to step to stop.

    Its mirror image is half a period off, as the feet of a trot are.
    """
    angle = 2 * torch.pi * frequency * state.time_s
    return torch.stack((angle.sin(), angle.cos()), 1) * ~rests(state, rest_s)[:, None]


@mirrors(JOINTS, JOINTS, VECTOR, ROTATION, VECTOR)
def true_proprioception(state: EnvState, joint_vel_scale: float = 1.0, ang_vel_scale: float = 1.0) -> torch.Tensor:
    """The 33 proprioceptive values without latency or noise: privileged."""
    k = state.kinematics
    return torch.cat(
        (
            k.joint_pos - state.default_joint_pos,
            k.joint_vel * joint_vel_scale,
            k.base_lin_vel_b,
            k.base_ang_vel_b * ang_vel_scale,
            k.projected_gravity_b,
        ),
        1,
    )


@mirrors(VECTOR)
def true_base_lin_vel(state: EnvState) -> torch.Tensor:
    """Base linear velocity in the base frame, m/s, without latency or error: privileged."""
    return state.kinematics.base_lin_vel_b


@mirrors((1.0,))
def base_height(state: EnvState) -> torch.Tensor:
    """Height (m) of the base origin above the ground, less the default pose's: privileged."""
    return state.base_height[:, None] - state.default_base_height


# in the order of randomization.DRAWN
@mirrors((1.0, 1.0), JOINT_MAGNITUDES, VECTOR, JOINTS, (1.0, 1.0, 1.0), VECTOR)
def drawn_physics(state: EnvState) -> torch.Tensor:
    """What randomization drew for the physics and the actuation; see `Randomizer.drawn`: privileged."""
    return state.drawn_physics


def heights(state: EnvState) -> torch.Tensor:
    """The 187-point height grid around the robot: privileged."""
    return state.heights


@mirrors((1.0, -1.0, 1.0, -1.0, 1.0, 1.0))
def nearest_obstacles(state: EnvState, count: int, max_distance: float) -> torch.Tensor:
    """Relative position, relative velocity, radius and nearness of the nearest obstacles: privileged.

    Per obstacle, nearest edge first, in the yaw-aligned frame: x, y (m, divided by max_distance), v_x, v_y (m/s),
    radius (m), and 1 - distance / max_distance (0 beyond, or when fewer obstacles take part). Edges and radii are those
    of the circles around the footprints, which say little about long walls. No wider than there are obstacles.
    """
    pos, vel, radius, active, *_ = state.obstacles
    distance = (pos.norm(dim=-1) - radius).masked_fill(~active, float("inf"))
    nearest, index = distance.topk(min(count, distance.shape[1]), dim=1, largest=False)
    nearness = (1 - nearest / max_distance).clamp(min=0.0)
    gather = index[..., None].expand(-1, -1, 2)
    rel_vel = vel - state.kinematics.base_lin_vel_yaw[:, None]
    features = torch.cat(
        (
            pos.gather(1, gather) / max_distance,
            rel_vel.gather(1, gather),
            radius.gather(1, index)[..., None],
            nearness[..., None],
        ),
        -1,
    )
    return (features * (nearness > 0)[..., None]).flatten(1)


@requires("avoidance")
@mirrors((1.0, -1.0))
def avoidance_target(state: EnvState) -> torch.Tensor:
    """The avoidance velocity (m/s, yaw-aligned frame) that the reward asks for: privileged."""
    return state.avoidance_velocity
