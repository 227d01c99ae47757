"""A simulator of one's own: MuJoCo with motors that follow their targets late."""

from __future__ import annotations

import math

import torch

from omniperception.common.checked import Positive, checked
from omniperception.scene import World
from omniperception.sim import MujocoSimulator, SimConfig


@checked("sim")
class LateMotorsConfig(SimConfig):
    """MuJoCo's settings and the motors'.

    Attributes:
        time_constant_s: s until 63 % of a new target has reached the motors.
    """

    time_constant_s: Positive = 0.02

    def build(self, world: World, num_envs: int, record_states: bool = False) -> LateMotors:
        """`num_envs` simulations of a world."""
        return LateMotors(world, self, num_envs, record_states)


class LateMotors(MujocoSimulator):
    """`num_envs` simulations whose joint targets approach the given ones exponentially, from one call to the next."""

    def __init__(self, world: World, config: LateMotorsConfig, num_envs: int, record_states: bool) -> None:
        super().__init__(world, config, num_envs, record_states)
        self._time_constant = config.time_constant_s
        self._late_target = self.robot_state()[0][:, 7:].clone()

    def step(
        self,
        joint_target: torch.Tensor,
        num_steps: int = 1,
        mocap_path: torch.Tensor | None = None,
        mocap_turn: torch.Tensor | None = None,
    ) -> None:
        share = 1.0 - math.exp(-num_steps * self.config.timestep / self._time_constant)
        late = torch.lerp(self._late_target, joint_target, share)
        self._late_target = torch.where(late.isfinite(), late, self._late_target)
        super().step(late, num_steps, mocap_path, mocap_turn)  # which marks targets that are not finite

    def reset(self, env_ids: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        super().reset(env_ids, qpos, qvel)
        self._late_target[env_ids] = qpos[:, 7:].float()

    def state_dict(self) -> dict:
        return super().state_dict() | {"late_target": self._late_target.clone()}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self._late_target.copy_(state["late_target"])
