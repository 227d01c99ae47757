"""Obstacles seen from above, as the true velocity risk needs them: capsules in the plane that move."""

from __future__ import annotations

import math

import torch
import warp as wp

from omniperception.perception.launch import launch_over_envs, view
from omniperception.perception.velocity_risk import VelocityRisk
from omniperception.task.rotations import rotate_yaw
from omniperception.task.state import Kinematics
from omniperception.world import ObstacleField, ObstaclesConfig
from omniperception.world.obstacles import Obstacle

HEADROOM = 0.45
"""What hangs at least this high (m) above the ground lets the robot pass."""
_FAR = wp.constant(5.0)
"""Gaps beyond this many decays (a risk below 0.7 %) do not count."""
_CORNERS = 1.2
"""A box is taken for a capsule along its longer side with the shorter half extent times this as radius."""


class TrueVelocityRisk:
    """Risks of the candidate velocities from the true places, outlines and velocities of all obstacles."""

    def __init__(
        self,
        config: VelocityRisk,
        obstacles: ObstaclesConfig,
        field: ObstacleField | None,
        num_envs: int,
        device: torch.device,
    ) -> None:
        """Args: config; obstacles: every obstacle; field: where the placed ones are, or None without any."""
        self.config, self._field, self._num_envs, self._device = config, field, num_envs, device
        self.candidates = config.candidates(device)
        slots = obstacles.slots()
        placed = [slot for slot in slots if slot.pose is None]
        fixed = [slot for slot in slots if slot.pose is not None]
        outlines = torch.tensor([_outline(slot) for slot in (*placed, *fixed)], device=device).reshape(-1, 2)
        self._half_length, self._radius = outlines[:, 0].contiguous(), outlines[:, 1].contiguous()
        poses = torch.tensor([slot.pose for slot in fixed], device=device).reshape(-1, 3)
        turn = (math.pi / 2) * torch.tensor([_lies_across(slot) for slot in (*placed, *fixed)], device=device)
        self._turn = turn[: len(placed)]
        self._fixed_xy, self._fixed_yaw = poses[:, :2], torch.deg2rad(poses[:, 2]) + turn[len(placed) :]
        times = torch.tensor(config.times, device=device)
        self._times, self._discounts = times, (-times / config.time_constant).exp()

    def measure(self, kinematics: Kinematics) -> torch.Tensor:
        """(num_envs, K) at the present state."""
        risk = torch.zeros(self._num_envs, self.config.num_candidates, device=self._device)
        if len(self._radius):
            xy, yaw, velocity, counts = self._obstacles()
            place = rotate_yaw(-kinematics.yaw, xy - kinematics.base_pos_w[:, None, :2])
            velocity = rotate_yaw(-kinematics.yaw, velocity)
            heading = yaw - kinematics.yaw[:, None]
            axis = self._half_length[:, None] * torch.stack((heading.cos(), heading.sin()), -1)
            inputs = [
                view(place, wp.vec2),
                view(axis, wp.vec2),
                view(velocity, wp.vec2),
                view(counts, wp.bool),
                view(self._radius, wp.float32),
                view(self.candidates, wp.vec2),
                view(self._times, wp.float32),
                view(self._discounts, wp.float32),
                self.config.robot_radius,
                self.config.decay,
                view(risk, wp.float32),
            ]
            launch_over_envs(velocity_risks, self._num_envs, inputs, self._device)
        return risk

    def _obstacles(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Places (n, O, 2), orientations (n, O) of the long axes, velocities (n, O, 2), and which count (n, O)."""
        n, field = self._num_envs, self._field
        fixed_xy, fixed_yaw = self._fixed_xy.expand(n, -1, -1), self._fixed_yaw.expand(n, -1)
        if field is None:
            return fixed_xy, fixed_yaw, torch.zeros_like(fixed_xy), torch.ones_like(fixed_yaw, dtype=torch.bool)
        yaw = field.yaw.float() + self._turn
        counts = field.active & (field.bottom_above_ground() < HEADROOM)
        return (
            torch.cat((field.pos_w[..., :2].float(), fixed_xy), 1),
            torch.cat((yaw, fixed_yaw), 1),
            torch.cat((field.velocity_w.float(), torch.zeros_like(fixed_xy)), 1),
            torch.cat((counts, torch.ones_like(fixed_yaw, dtype=torch.bool)), 1),
        )


def _outline(slot: Obstacle) -> tuple[float, float]:
    """Half length of the axis and radius (m) of the capsule that an obstacle is from above."""
    if slot.kind != "box":
        return 0.0, slot.size[0]
    short, long = sorted(slot.size[:2])
    return long - short, _CORNERS * short


def _lies_across(slot: Obstacle) -> bool:
    return slot.kind == "box" and slot.size[1] > slot.size[0]


@wp.kernel(module="unique", enable_backward=False)
def velocity_risks(
    env_offset: int,
    place: wp.array2d(dtype=wp.vec2),
    axis: wp.array2d(dtype=wp.vec2),
    velocity: wp.array2d(dtype=wp.vec2),
    counts: wp.array2d(dtype=wp.bool),
    radius: wp.array(dtype=wp.float32),
    candidates: wp.array(dtype=wp.vec2),
    times: wp.array(dtype=wp.float32),
    discounts: wp.array(dtype=wp.float32),
    robot_radius: float,
    decay: float,
    # out
    risk_out: wp.array2d(dtype=wp.float32),
):
    """Largest discounted risk of each candidate of one environment; see `VelocityRisk`."""
    env = wp.tid() + env_offset
    top_speed = wp.float32(0.0)
    for k in range(candidates.shape[0]):
        top_speed = wp.max(top_speed, wp.length(candidates[k]))
    horizon = wp.float32(0.0)
    for t in range(times.shape[0]):
        horizon = wp.max(horizon, times[t])
    for o in range(place.shape[1]):
        if counts[env, o]:
            p = place[env, o]
            half = axis[env, o]
            w = velocity[env, o]
            edge = radius[o] + robot_radius
            reach = (top_speed + wp.length(w)) * horizon + wp.length(half) + edge + _FAR * decay
            if wp.length(p) < reach:
                squared = wp.max(wp.dot(half, half), 1.0e-9)
                for k in range(candidates.shape[0]):
                    approach = w - candidates[k]
                    worst = risk_out[env, k]
                    for t in range(times.shape[0]):
                        q = p + times[t] * approach
                        along = wp.clamp(-wp.dot(q, half) / squared, -1.0, 1.0)
                        gap = wp.length(q + along * half) - edge
                        if gap < _FAR * decay:
                            worst = wp.max(worst, discounts[t] * wp.exp(-wp.max(gap, 0.0) / decay))
                    risk_out[env, k] = worst
