"""Commands that a person gives: a task's own commands until somebody takes over."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from omniperception.env.config import EnvConfig
from omniperception.env.kinematics import Kinematics
from omniperception.env.mdp.commands import (
    GoalCommand,
    GoalCommandConfig,
    VelocityCommand,
    VelocityCommandConfig,
)

MAX_SPEED, MAX_YAW_RATE = 1.5, 1.5
"""Most that a person can command (m/s, rad/s)."""

Velocity = tuple[float, float, float]


class _Driven:
    """Mixin of a source of commands: `driven` replaces what it gives.

    Attributes:
        driven: v_x, v_y (m/s) and yaw rate (rad/s) in the base frame; None: the task's own commands.
    """

    driven: Velocity | None = None
    value: torch.Tensor

    def reset(self, env_ids: torch.Tensor, kinematics: Kinematics) -> None:
        super().reset(env_ids, kinematics)  # type: ignore[misc]  # of the command that this is mixed into
        self.take_over()

    def advance(self, dt: float, kinematics: Kinematics) -> None:
        super().advance(dt, kinematics)  # type: ignore[misc]
        self.take_over()

    def take_over(self) -> None:
        """Puts what a person gives in the place of the task's own."""
        if self.driven is not None:
            self.value.copy_(self.value.new_tensor(self.driven).expand_as(self.value))


class DrivenVelocity(_Driven, VelocityCommand):
    """Velocities that are drawn until somebody drives."""


class DrivenGoal(_Driven, GoalCommand):
    """Commands to a goal until somebody drives; the goal stays."""

    def follow(self, env_ids: torch.Tensor, route: torch.Tensor, kinematics: Kinematics) -> None:
        super().follow(env_ids, route, kinematics)
        self.take_over()


class DrivenVelocityConfig(VelocityCommandConfig):
    """Settings of `DrivenVelocity`."""

    def build(self, num_envs, device, random) -> DrivenVelocity:
        return DrivenVelocity(self, num_envs, device, random)


class DrivenGoalConfig(GoalCommandConfig):
    """Settings of `DrivenGoal`."""

    def build(self, num_envs, device, random) -> DrivenGoal:
        return DrivenGoal(self, num_envs, device, random)


def driven(config: EnvConfig) -> VelocityCommandConfig | GoalCommandConfig:
    """The commands of a task, such that a person can take over."""
    commands = config.commands
    kind = DrivenVelocityConfig if isinstance(commands, VelocityCommandConfig) else DrivenGoalConfig
    return kind(**{field.name: getattr(commands, field.name) for field in fields(commands)})


@dataclass
class Stick:
    """What a person holds: a command that keys and sliders change in steps, within bounds."""

    value: Velocity = (0.0, 0.0, 0.0)

    def moved(self, ahead: float = 0.0, aside: float = 0.0, turn: float = 0.0) -> Velocity:
        """The command after a step (m/s, m/s, rad/s)."""
        x, y, yaw = self.value
        return self.set((x + ahead, y + aside, yaw + turn))

    def set(self, value: Velocity) -> Velocity:
        """Takes a command within the bounds."""
        x, y, yaw = value
        self.value = _bounded(x, MAX_SPEED), _bounded(y, MAX_SPEED), _bounded(yaw, MAX_YAW_RATE)
        return self.value


def _bounded(value: float, most: float) -> float:
    return round(min(max(float(value), -most), most), 3)
