"""Policies to compare with: one whose LiDAR is covered, and one that is steered by the true distances of obstacles."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict

from omniperception.evaluation.episodes import Policy
from omniperception.perception import Attitude
from omniperception.task.env import OmniEnv
from omniperception.task.rewards import AvoidanceConfig, avoidance_velocity
from omniperception.task.rotations import rotate_yaw
from omniperception.task.true_risk import HEADROOM, TrueVelocityRisk

COMMAND_GROUP = "command"
"""The observation group that begins with the commanded velocity (v_x, v_y)."""

Limits = tuple[tuple[float, float], tuple[float, float]]
"""Ranges of v_x and v_y (m/s)."""


def covered(env: OmniEnv, policy: Policy) -> Policy:
    """The policy with its LiDAR covered: every ray is a miss, and all frames are what the sampler makes of that."""
    if env.sensing is None or env.sensing.frames is None:
        raise ValueError("this policy does not look at the LiDAR, there is nothing to cover; leave policy=blind out")
    frames = _empty_points(env).expand_as(env.sensing.frames)

    def blind(observations: TensorDict) -> torch.Tensor:
        observations = observations.clone(recurse=False)
        observations["frames"] = frames
        return policy(observations)

    return blind


def steered(env: OmniEnv, policy: Policy, avoidance: AvoidanceConfig, limits: Limits | None) -> Policy:
    """The policy told V_cmd + V_avoid in place of V_cmd, with V_avoid from the obstacles' true distances.

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
    true_avoidance = _from_risk(env, avoidance) if avoidance.risk is not None else _from_sectors(env, avoidance)

    def steer(observations: TensorDict) -> torch.Tensor:
        velocity = env.command.value[:, :2] + true_avoidance()
        if limits is not None:
            low, high = velocity.new_tensor(limits).unbind(1)
            velocity = velocity.clamp(low, high)
        observations = observations.clone(recurse=False)
        observations[COMMAND_GROUP] = torch.cat((velocity, env.command.value[:, 2:]), 1)
        return policy(observations)

    return steer


def _from_sectors(env: OmniEnv, avoidance: AvoidanceConfig) -> Callable[[], torch.Tensor]:
    sectors = TrueSectors(env, avoidance.num_sectors)
    return lambda: avoidance_velocity(sectors.measure(), avoidance)


def _from_risk(env: OmniEnv, avoidance: AvoidanceConfig) -> Callable[[], torch.Tensor]:
    law = avoidance.risk
    risk = TrueVelocityRisk(law, env.world.obstacles, env.obstacles, env.num_envs, env.device)
    return lambda: law.avoidance(risk.measure(env.kinematics), env.command.value[:, :2], risk.candidates)


def _empty_points(env: OmniEnv) -> torch.Tensor:
    """(1, 1, num_points, 3) what the run's sampler makes of a frame without a hit."""
    sampler, sensor = env.config.sampler(), env.config.lidar.sensor
    rays = sampler.num_points  # as many as the raw sampler needs; any number of misses is the same to the others
    points = torch.zeros(1, rays, 3, device=env.device)
    directions, angles = torch.zeros_like(points), torch.zeros(1, rays, device=env.device)
    attitude = Attitude(angles.new_tensor([[1.0, 0.0, 0.0, 0.0]]), sensor.mount_pos, sensor.quat)
    sampler(torch.full_like(angles, torch.inf), directions, angles, angles, points, attitude)
    return points[:, None]


class TrueSectors:
    """Horizontal distances of the obstacles' outlines from the base, by sector, from their true poses."""

    def __init__(self, env: OmniEnv, num_sectors: int) -> None:
        self._env, self.num_sectors = env, num_sectors
        slots = env.world.obstacles.slots()
        self._placed = [i for i, slot in enumerate(slots) if slot.pose is None]
        device = env.device
        self._is_box = torch.tensor([slot.kind == "box" for slot in slots], device=device)
        self._half = torch.tensor([(*slot.size, 0.0)[:2] for slot in slots], device=device)
        poses = [slot.pose or (0.0, 0.0, 0.0) for slot in slots]
        fixed = torch.tensor(poses, device=device).expand(env.num_envs, -1, -1)
        self._xy, self._yaw = fixed[..., :2].clone(), torch.deg2rad(fixed[..., 2])
        self._bottom = torch.zeros_like(self._yaw)
        edges = -torch.pi + torch.arange(num_sectors, device=device) * (2 * torch.pi / num_sectors)
        self._edges = torch.stack((edges.cos(), edges.sin()), -1)

    def measure(self) -> torch.Tensor:
        """(num_envs, num_sectors) m in the yaw-aligned frame; infinite in a sector without an obstacle.

        Sector j holds the bearings [-pi + j 2 pi/n, -pi + (j + 1) 2 pi/n). Obstacles that do not take part, or that
        hang above HEADROOM, do not count.
        """
        self._read_poses()
        motion = self._env.kinematics
        centre = rotate_yaw(-motion.yaw, self._xy - motion.base_pos_w[:, None, :2])
        turned = self._yaw - motion.yaw[:, None]
        counts = (self._bottom > -1.0) & (self._bottom < HEADROOM)
        nearest = self._nearest_point(centre, turned)
        distance = torch.where(counts, nearest.norm(dim=-1), torch.inf)
        sector = ((torch.atan2(nearest[..., 1], nearest[..., 0]) / (2 * torch.pi) + 0.5) * self.num_sectors).long()
        sectors = torch.full((len(centre), self.num_sectors), torch.inf, device=centre.device)
        sectors = sectors.scatter_reduce(1, sector % self.num_sectors, distance, "amin")
        on_edge = torch.where(counts[..., None], self._along_edges(centre, turned), torch.inf).amin(1)
        return torch.minimum(sectors, torch.minimum(on_edge, on_edge.roll(-1, 1)))

    def _read_poses(self) -> None:
        field = self._env.obstacles
        if field is None:
            return
        self._xy[:, self._placed] = field.pos_w[..., :2].float()
        self._yaw[:, self._placed] = field.yaw.float()
        self._bottom[:, self._placed] = field.bottom_above_ground().float()

    def _nearest_point(self, centre: torch.Tensor, turned: torch.Tensor) -> torch.Tensor:
        """(n, O, 2) the point of each outline that is nearest to the base, in the yaw-aligned frame."""
        distance = centre.norm(dim=-1, keepdim=True).clamp(min=1e-9)
        on_circle = centre * (1 - self._half[:, :1] / distance).clamp(min=0.0)
        base = -_turn(-turned, centre)  # seen from the box
        on_box = centre + _turn(turned, base.clamp(-self._half, self._half))
        return torch.where(self._is_box[:, None], on_box, on_circle)

    def _along_edges(self, centre: torch.Tensor, turned: torch.Tensor) -> torch.Tensor:
        """(n, O, num_sectors) distance at which the edge where each sector begins enters each outline, else inf."""
        along = centre @ self._edges.T
        half_chord = self._half[:, :1].square() - centre.square().sum(-1, keepdim=True) + along.square()
        circle_in = along - half_chord.clamp(min=0.0).sqrt()
        circle = torch.where((half_chord > 0) & (along > 0), circle_in.clamp(min=0.0), torch.inf)
        base = -_turn(-turned, centre)[:, :, None]
        direction = _turn(-turned[..., None], self._edges.expand(*turned.shape, -1, -1))
        direction = torch.where(direction.abs() < 1e-9, 1e-9, direction)
        half = self._half[:, None]
        slabs = torch.stack(((-half - base) / direction, (half - base) / direction))
        enter, leave = slabs.amin(0).amax(-1), slabs.amax(0).amin(-1)
        box = torch.where((enter <= leave) & (leave > 0), enter.clamp(min=0.0), torch.inf)
        return torch.where(self._is_box[:, None], box, circle)


def _turn(angle: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Turns vectors (..., 2) by angles (...) (rad)."""
    cos, sin = angle.cos(), angle.sin()
    x, y = vec.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), -1)
