"""Pushes: sudden changes of the base's horizontal velocity."""

from __future__ import annotations

import math

import torch

from omniperception.common.random import Branch
from omniperception.common.stateful import Stateful
from omniperception.env.mdp.curriculum import FULL, Curriculum
from omniperception.env.mdp.randomization import PushesConfig
from omniperception.sim import Simulator


class Pushes(Stateful):
    """Pushes each environment's robot at times and in directions of its own.

    Attributes:
        countdown: (num_envs,) int64 control steps until the next push; it comes in the step that begins at 0.
    """

    saved = ("countdown",)

    def __init__(
        self, config: PushesConfig, sim: Simulator, control_dt: float, random: Branch, curriculum: Curriculum = FULL
    ) -> None:
        """
        Args:
            config: how often and how hard.
            sim: whom.
            control_dt: s.
            random: streams to draw from.
            curriculum: of the share of the speed.
        """
        self._config, self._sim, self._dt, self._random, self._curriculum = config, sim, control_dt, random, curriculum
        self.countdown = torch.zeros(sim.num_envs, dtype=torch.int64, device=sim.device)
        self._all_envs = torch.arange(sim.num_envs, device=sim.device)

    def advance(self) -> None:
        """Pushes whom it is time to push, before the physics of a control step."""
        u, speed, bearing = self._random.uniform(self._all_envs, (3,)).unbind(1)
        due = self.countdown == 0
        turn = 2.0 * math.pi * bearing
        kick = self._curriculum.level * self._config.speed * speed[:, None] * torch.stack((turn.cos(), turn.sin()), 1)
        velocity = self._sim.qvel[:, :2]
        velocity.copy_(torch.where(due[:, None], velocity + kick.to(velocity.dtype), velocity))
        self.countdown.copy_(torch.where(due, self._steps(u), self.countdown) - 1)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Draws when the first push of environments (n,) comes."""
        self._random.start_episode(env_ids)
        u, part = self._random.uniform(env_ids, (2,)).unbind(1)
        self.countdown[env_ids] = (part * self._steps(u)).long()

    def _steps(self, u: torch.Tensor) -> torch.Tensor:
        """(n,) int64 control steps from one push to the next, at least 1; `u` (n,) uniform in [0, 1)."""
        low, high = self._config.every_s
        return ((low + u * (high - low)) / self._dt).round().long().clamp(min=1)
