"""How LiDAR frames come: some are lost, some lack points, and what they show is some time ago."""

from __future__ import annotations

import torch

from omniperception.common.random import Branch
from omniperception.common.stateful import Stateful
from omniperception.env.partial_frames import PartialFrames


class FrameDelivery(Stateful):
    """Draws for every frame of every environment whether it comes, and how late.

    Attributes:
        fresh: (num_envs,) bool: whose newest frame came.
        late_steps: (num_envs,) int64 control steps by which the scene that it shows is older than the moment it comes.
        max_late_steps: the largest of them.
        partial: takes points away; None: all frames are whole.
    """

    saved, buffers = ("partial",), ("fresh", "late_steps")

    def __init__(
        self,
        lost: float | None,
        late_s: tuple[float, float] | None,
        control_dt: float,
        num_envs: int,
        random: Branch,
        partial: PartialFrames | None = None,
    ) -> None:
        """
        Args:
            lost: share of the frames; None for none.
            late_s: range of the age (s), rounded to control steps; None for none.
            control_dt: s.
            num_envs: environments.
            random: streams to draw from, and nobody else.
            partial: takes points away; None: nothing does.
        """
        self.partial = partial
        self._lost, (self._low, high) = lost or 0.0, late_s or (0.0, 0.0)
        self._span, self._dt, self._random = high - self._low, control_dt, random
        device = random.counter.device
        self._all_envs = torch.arange(num_envs, device=device)
        self.fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.late_steps = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.max_late_steps = round(high / control_dt)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Episodes begin in environments (n,)."""
        self._random.start_episode(env_ids)
        if self.partial is not None:
            self.partial.reset(env_ids)

    def draw(self) -> None:
        """Draws for the next frame."""
        lost, late = self._random.uniform(self._all_envs, (2,)).unbind(1)
        torch.ge(lost, self._lost, out=self.fresh)
        steps = ((self._low + self._span * late) / self._dt).round()
        self.late_steps.copy_(steps.clamp(max=self.max_late_steps))  # float32 rounds half steps anyhow
        if self.partial is not None:
            self.partial.draw()


class PastPoses(Stateful):
    """Poses of bodies at the newest control steps, in a ring."""

    saved = ("_pos", "_quat", "_newest")

    def __init__(self, num_steps: int, num_envs: int, num_bodies: int, device: torch.device) -> None:
        """Args: num_steps: control steps kept, the present one included; num_envs; num_bodies; device."""
        self._pos = torch.zeros(num_steps, num_envs, num_bodies, 3, device=device)
        self._quat = torch.zeros(num_steps, num_envs, num_bodies, 4, device=device)
        self._newest = 0
        self._all_envs = torch.arange(num_envs, device=device)

    def record(self, pos: torch.Tensor, quat: torch.Tensor) -> None:
        """Takes in the poses (num_envs, num_bodies, 3 and 4) at the end of a control step."""
        self._newest = (self._newest + 1) % len(self._pos)
        self._pos[self._newest].copy_(pos)
        self._quat[self._newest].copy_(quat)

    def reset(self, env_ids: torch.Tensor, pos: torch.Tensor, quat: torch.Tensor) -> None:
        """Makes the present poses of environments (n,), out of those of all, those that they have had all along."""
        self._pos.index_copy_(1, env_ids, pos[env_ids].expand(len(self._pos), -1, -1, -1))
        self._quat.index_copy_(1, env_ids, quat[env_ids].expand(len(self._quat), -1, -1, -1))

    def at(self, steps_ago: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Poses of each environment as many control steps ago, (num_envs,) int64."""
        index = torch.remainder(self._newest - steps_ago, len(self._pos))
        return self._pos[index, self._all_envs], self._quat[index, self._all_envs]
