"""Errors of what the robot measures of itself: velocity estimate, IMU and joint encoders."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from omniperception.common.random import Branch, EnvRandom
from omniperception.common.rotations import multiply, rotate
from omniperception.common.stateful import Stateful
from omniperception.env.kinematics import Kinematics
from omniperception.env.mdp.curriculum import FULL, Curriculum
from omniperception.env.mdp.randomization import Drift, RandomizationConfig


class MeasurementErrors(Stateful):
    """Draws the errors of each environment's measurements and adds them to a state.

    Biases and scale errors hold for an episode, noise for a control step. Where a row is null nothing is drawn.
    """

    saved = ("_bias", "_noise", "_drift")

    def __init__(
        self,
        config: RandomizationConfig,
        num_envs: int,
        num_joints: int,
        control_dt: float,
        random: Branch,
        curriculum: Curriculum = FULL,
    ) -> None:
        """
        Args:
            config: with at least one row of errors.
            num_envs: environments.
            num_joints: of the robot.
            control_dt: s.
            random: streams to draw from, and nobody else.
            curriculum: of the share of the errors.
        """
        biases = {"velocity_scale": 1, "gyro_bias": 3, "attitude_bias_deg": 2}
        noises = {
            "gyro_noise": 3,
            "attitude_noise_deg": 2,
            "joint_pos_noise": num_joints,
            "joint_vel_noise": num_joints,
        }
        self._random, self._curriculum = random, curriculum
        self._bias = _Uniforms(config, biases, num_envs, random)
        self._noise = _Uniforms(config, noises, num_envs, random)
        self._drift = None
        if config.velocity_drift is not None:
            self._drift = _Wander(config.velocity_drift, num_envs, control_dt, random)
        self._tilts = config.attitude_bias_deg is not None or config.attitude_noise_deg is not None
        self._moves = config.velocity_scale is not None or self._drift is not None
        self._all_envs = torch.arange(num_envs, device=random.counter.device)

    def advance(self) -> None:
        """Draws what is new in a control step."""
        self._noise.draw(self._all_envs)
        if self._drift is not None:
            self._drift.advance(self._all_envs)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Draws all errors of environments (n,), whose episodes begin."""
        self._random.start_episode(env_ids)
        self._bias.draw(env_ids)
        self._noise.draw(env_ids)
        if self._drift is not None:
            self._drift.reset(env_ids)

    def added_to(self, state: Kinematics) -> Kinematics:
        """What is measured in a state, of all environments; its position stays true: nothing measures it."""
        level = self._curriculum.level
        bias, noise = self._bias.shares(level), self._noise.shares(level)
        quat, velocity_w = state.base_quat_w, state.base_lin_vel_w
        if self._tilts:
            quat = multiply(quat, _tilt(_sum(bias.get("attitude_bias_deg"), noise.get("attitude_noise_deg"))))
        if self._tilts or self._moves:
            velocity_b = state.base_lin_vel_b * bias.get("velocity_scale", 1.0)
            velocity_w = rotate(quat, velocity_b if self._drift is None else velocity_b + level * self._drift.value)
        return Kinematics(
            torch.cat((state.base_pos_w, quat, _sum(state.joint_pos, noise.get("joint_pos_noise"))), 1),
            torch.cat(
                (
                    velocity_w,
                    _sum(state.base_ang_vel_b, bias.get("gyro_bias"), noise.get("gyro_noise")),
                    _sum(state.joint_vel, noise.get("joint_vel_noise")),
                ),
                1,
            ),
        )


class _Uniforms(Stateful):
    """Numbers drawn uniformly from the ranges of some rows; angles in rad.

    Attributes:
        values: (num_envs, sum of the widths) of the rows that are not null.
        rows: (num_envs, width) each, views of `values` by name.
    """

    buffers = ("values",)

    def __init__(
        self, config: RandomizationConfig, widths: Mapping[str, int], num_envs: int, random: EnvRandom
    ) -> None:
        self._random, device = random, random.counter.device
        there = {name: width for name, width in widths.items() if getattr(config, name) is not None}
        bounds = [_in_rad(name, getattr(config, name)) for name, width in there.items() for _ in range(width)]
        low, high = torch.tensor(bounds, device=device).reshape(-1, 2).unbind(1)
        self._low, self._span = low, high - low
        self.values = torch.zeros(num_envs, len(bounds), device=device)
        self.rows = dict(zip(there, self.values.split(list(there.values()), 1), strict=True)) if there else {}

    def shares(self, level: float) -> Mapping[str, torch.Tensor]:
        """The rows at a share of their ranges, about what is measured without errors."""
        if level >= 1.0:
            return self.rows
        neutral = {"velocity_scale": 1.0}
        return {name: (n := neutral.get(name, 0.0)) + level * (row - n) for name, row in self.rows.items()}

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draws for environments (n,)."""
        if self.rows:
            u = self._random.uniform(env_ids, self._low.shape)
            self.values.index_copy_(0, env_ids, self._low + self._span * u)


class _Wander(Stateful):
    """A `Drift` of three axes in every environment, stepped exactly.

    Attributes:
        value: (num_envs, 3).
    """

    saved = ("value",)

    def __init__(self, config: Drift, num_envs: int, dt: float, random: EnvRandom) -> None:
        self._sd, self._random = config.sd, random
        self._keeps = math.exp(-dt / config.time_s)
        self.value = torch.zeros(num_envs, 3, device=random.counter.device)

    def advance(self, all_envs: torch.Tensor) -> None:
        """One step: keeps a part of the value and adds what keeps its variance."""
        self.value.mul_(self._keeps).add_(self._innovation(all_envs), alpha=math.sqrt(1.0 - self._keeps**2))

    def reset(self, env_ids: torch.Tensor) -> None:
        self.value.index_copy_(0, env_ids, self._innovation(env_ids))

    def _innovation(self, env_ids: torch.Tensor) -> torch.Tensor:
        """(n, 3) numbers of the drift's standard deviation; sums of many are normal, one is uniform."""
        return self._sd * math.sqrt(12.0) * (self._random.uniform(env_ids, (3,)) - 0.5)


def _in_rad(name: str, bounds: tuple[float, float]) -> tuple[float, ...]:
    return tuple(math.radians(bound) for bound in bounds) if name.endswith("_deg") else bounds


def _sum(*parts: torch.Tensor | None) -> torch.Tensor:
    """Sum of those that are there, at least one."""
    first, *others = (part for part in parts if part is not None)
    return sum(others, start=first)


def _tilt(angles: torch.Tensor) -> torch.Tensor:
    """Quaternions (n, 4) of the turns by the rotation vectors (roll, pitch, 0), angles (n, 2) in rad."""
    angle = angles.norm(dim=1, keepdim=True)
    axis = torch.cat((angles, torch.zeros_like(angle)), 1) * (0.5 * torch.sinc(angle / (2.0 * torch.pi)))
    return torch.cat(((angle / 2.0).cos(), axis), 1)
