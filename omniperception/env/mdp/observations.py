"""Observation terms, and the history of a group of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from omniperception.common.rows import put, take
from omniperception.env.mdp.terms import ObservationGroup
from omniperception.env.mirror import JOINTS, ROTATION, VECTOR, mirrors
from omniperception.env.state import reads

if TYPE_CHECKING:
    from omniperception.env.env import OmniEnv


class GroupBuffer:
    """Holds one group's history, if it has one, and writes each new observation into it."""

    def __init__(self, name: str, group: ObservationGroup, env: OmniEnv) -> None:
        self._terms = tuple(group.terms.values())
        self.slices: dict[str, slice] = {}
        start = 0
        for term_name, term in group.terms.items():
            value = term(env)
            if value.dim() != 2 or value.shape[0] != env.num_envs:
                raise ValueError(
                    f"observation {name}.{term_name} has shape {tuple(value.shape)}, expected ({env.num_envs}, width)"
                )
            self.slices[term_name] = slice(start, start + value.shape[1])
            start += value.shape[1]
        self.width = start
        self.buffer: torch.Tensor | None = None
        if group.history > 1:
            self.buffer = torch.zeros(env.num_envs, group.history, self.width, device=env.device)

    def update(self, env: OmniEnv, fresh: torch.Tensor) -> torch.Tensor:
        """Appends the current observation, which is all that the history of `fresh` environments holds (see `rows`).

        Returns:
            (num_envs, history * width).
        """
        values = [term(env) for term in self._terms]
        value = torch.cat(values, 1) if len(values) > 1 else values[0].clone()
        if self.buffer is None:
            return value
        self.buffer = torch.cat((self.buffer[:, 1:], value[:, None]), 1)
        put(self.buffer, fresh, take(value, fresh)[:, None])
        return self.buffer.flatten(1)


@mirrors(JOINTS)
def joint_pos_offset(env: OmniEnv) -> torch.Tensor:
    """Joint position relative to the default pose, rad, as sensed (with latency when randomized)."""
    return env.sensed.joint_pos - env.default_joint_pos


@mirrors(JOINTS)
def joint_vel(env: OmniEnv, scale: float = 1.0) -> torch.Tensor:
    """Joint velocity, rad/s, times `scale`, as sensed."""
    return env.sensed.joint_vel * scale


@mirrors(VECTOR)
def base_lin_vel(env: OmniEnv) -> torch.Tensor:
    """Base linear velocity in the base frame, m/s, as sensed."""
    return env.sensed.base_lin_vel_b


@mirrors(ROTATION)
def base_ang_vel(env: OmniEnv, scale: float = 1.0) -> torch.Tensor:
    """Base angular velocity in the base frame, rad/s, times `scale`, as sensed."""
    return env.sensed.base_ang_vel_b * scale


@mirrors(VECTOR)
def projected_gravity(env: OmniEnv) -> torch.Tensor:
    """Unit vector of gravity in the base frame, as sensed."""
    return env.sensed.projected_gravity_b


@mirrors((1.0, -1.0, -1.0))
def command(env: OmniEnv) -> torch.Tensor:
    """v_x, v_y (m/s) and yaw rate (rad/s) in the base frame."""
    return env.command.value


@mirrors(JOINTS)
def previous_action(env: OmniEnv) -> torch.Tensor:
    """The action applied in the step that ended."""
    return env.actions[0]


@mirrors(JOINTS, JOINTS, VECTOR, ROTATION, VECTOR)
def true_proprioception(env: OmniEnv, joint_vel_scale: float = 1.0, ang_vel_scale: float = 1.0) -> torch.Tensor:
    """The 33 proprioceptive values without latency or noise: privileged."""
    k = env.kinematics
    return torch.cat(
        (
            k.joint_pos - env.default_joint_pos,
            k.joint_vel * joint_vel_scale,
            k.base_lin_vel_b,
            k.base_ang_vel_b * ang_vel_scale,
            k.projected_gravity_b,
        ),
        1,
    )


@mirrors((1.0,))
def base_height(env: OmniEnv) -> torch.Tensor:
    """Height (m) of the base origin above the ground, less the default pose's: privileged."""
    return env.base_height[:, None] - env.robot.base_height


@reads("heights")
def heights(env: OmniEnv) -> torch.Tensor:
    """The 187-point height grid around the robot: privileged."""
    return env.heights


@reads("obstacles")
@mirrors((1.0, -1.0, 1.0, -1.0, 1.0, 1.0))
def nearest_obstacles(env: OmniEnv, count: int, max_distance: float) -> torch.Tensor:
    """Relative position, relative velocity, radius and nearness of the nearest obstacles: privileged.

    Per obstacle, nearest edge first, in the yaw-aligned frame: x, y (m, divided by max_distance), v_x, v_y (m/s),
    radius (m), and 1 - distance / max_distance (0 beyond, or when fewer obstacles take part).
    """
    rel_pos = env.obstacle_rel_pos_yaw
    distance = rel_pos.norm(dim=-1) - env.obstacle_radius
    distance = distance.masked_fill(~env.obstacle_active, float("inf"))
    nearest, index = distance.topk(min(count, distance.shape[1]), dim=1, largest=False)
    nearness = (1 - nearest / max_distance).clamp(min=0.0)
    gather = index[..., None].expand(-1, -1, 2)
    rel_vel = env.obstacle_vel_yaw - env.kinematics.base_lin_vel_yaw[:, None]
    features = torch.cat(
        (
            rel_pos.gather(1, gather) / max_distance,
            rel_vel.gather(1, gather),
            env.obstacle_radius[index][..., None],
            nearness[..., None],
        ),
        -1,
    )
    return (features * (nearness > 0)[..., None]).flatten(1)


@reads("sectors")
@mirrors((1.0, -1.0))
def avoidance_target(env: OmniEnv) -> torch.Tensor:
    """The avoidance velocity (m/s, yaw-aligned frame) that the reward asks for: privileged."""
    return env.avoidance_velocity
