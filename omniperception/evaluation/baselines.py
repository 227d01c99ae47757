"""Policies to compare with: one whose LiDAR is covered, and one that is steered by the true distances of obstacles."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict

from omniperception.avoidance.true_sectors import TrueSectors
from omniperception.avoidance.velocity import AvoidanceConfig, avoidance_velocity
from omniperception.env.env import OmniEnv
from omniperception.evaluation.episodes import Policy
from omniperception.perception import Attitude

COMMAND_GROUP = "command"
"""The observation group that begins with the commanded velocity (v_x, v_y)."""

Limits = tuple[tuple[float, float], tuple[float, float]]
"""Ranges of v_x and v_y (m/s)."""


def covered(env: OmniEnv, policy: Policy) -> Policy:
    """The policy with its LiDAR covered: rays all miss, and the points of frames are what the sampler makes of it.

    How the base moved, which stands behind the points, stays as it is.
    """
    if env.sensing is None or env.sensing.frames is None:
        raise ValueError("this policy does not look at the LiDAR, there is nothing to cover; leave policy=blind out")
    nothing = _empty_points(env)
    given = frames = None

    def blind(observations: TensorDict) -> torch.Tensor:
        nonlocal given, frames
        if observations["frames"] is not given:  # a new frame; a policy embeds each tensor of frames once
            given, frames = observations["frames"], observations["frames"].clone()
            frames[:, :, : nothing.shape[2]] = nothing
        observations = observations.clone(recurse=False)
        observations["frames"] = frames
        return policy(observations)

    return blind


def steered(env: OmniEnv, policy: Policy, avoidance: AvoidanceConfig, limits: Limits | None) -> Policy:
    """The policy with V_cmd + V_avoid in place of V_cmd, with V_avoid from the obstacles' true distances.

    To a policy that sees, too, it is always before the first frame, so that it adds no avoidance of its own.

    Args:
        env: where it walks.
        policy: follows velocity commands.
        avoidance: how distances by sector, or the risk of velocities, become V_avoid.
        limits: ranges to which the sum is clipped: what the policy has learned to follow; None for no limits.
    """
    shape = env.get_observations()[COMMAND_GROUP].shape if COMMAND_GROUP in env.get_observations() else None
    if shape is None or shape[1] != env.command.value.shape[1]:
        raise ValueError(
            f"a steered policy needs observations with a group '{COMMAND_GROUP}' that holds the command alone, without"
            " history"
        )
    true_avoidance = _true_avoidance(env, avoidance)

    def steer(observations: TensorDict) -> torch.Tensor:
        velocity = env.command.value[:, :2] + true_avoidance()
        if limits is not None:
            low, high = velocity.new_tensor(limits).unbind(1)
            velocity = velocity.clamp(low, high)
        observations = observations.clone(recurse=False)
        observations[COMMAND_GROUP] = torch.cat((velocity, env.command.value[:, 2:]), 1)
        if "frame_count" in observations:
            observations["frame_count"] = torch.zeros_like(observations["frame_count"])
        return policy(observations)

    return steer


def _true_avoidance(env: OmniEnv, avoidance: AvoidanceConfig) -> Callable[[], torch.Tensor]:
    """V_avoid of the moment, from where the obstacles are."""
    sectors = TrueSectors(avoidance.num_sectors, env.world.obstacles, env.obstacles, env.num_envs, env.device)
    candidates = None if avoidance.risk is None else avoidance.risk.candidates(env.device)

    def velocity() -> torch.Tensor:
        kinematics = env.state.kinematics
        motion = sectors.measure(kinematics.base_pos_w, kinematics.yaw)
        if avoidance.risk is None or candidates is None:
            return avoidance_velocity(motion[..., 0], avoidance)
        risk = avoidance.risk.risk(motion, candidates)
        return avoidance.risk.avoidance(risk, env.command.value[:, :2], candidates)

    return velocity


def _empty_points(env: OmniEnv) -> torch.Tensor:
    """(1, 1, num_points, 3) what the run's sampler makes of a frame without a hit."""
    assert env.config.sampler is not None and env.config.lidar is not None  # it has frames
    sampler, sensor = env.config.sampler(), env.config.lidar
    rays = sampler.num_points  # as many as the raw sampler needs; any number of misses is the same to the others
    points = torch.zeros(1, rays, 3, device=env.device)
    directions, angles = torch.zeros_like(points), torch.zeros(1, rays, device=env.device)
    attitude = Attitude(angles.new_tensor([[1.0, 0.0, 0.0, 0.0]]), sensor.mount_pos, sensor.quat)
    sampler(torch.full_like(angles, torch.inf), directions, angles, angles, points, attitude)
    return points[:, None]
