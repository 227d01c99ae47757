"""LiDAR frames that hold only a part of their points, for a while."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal, get_args

import torch
from pydantic import Field

from omniperception.common.checked import AsTuple, InOrder, Inside, NonNegativePair, checked
from omniperception.common.random import Branch
from omniperception.common.stateful import Stateful

Kind = Literal["sector", "thin", "slice", "wedge"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""What is missing of a frame: an azimuth sector, the same in all frames; all but a share of the points, at random; all
but a share of the frame's time, the same in all frames; all but a share of the circle, another one in every frame."""
_THIN, _SLICE, _WEDGE = 1, 2, 3
_ANGLE = Field(ge=0, le=360)
_Degrees = Annotated[
    tuple[Annotated[float, _ANGLE], Annotated[float, _ANGLE]], AsTuple, InOrder, "[low, high], 0 to 360"
]
_Kinds = Annotated[tuple[Kind, ...], AsTuple, Field(min_length=1), f"some of {', '.join(KINDS)}"]


@checked("randomization.partial_frames")
class PartialFramesConfig:
    """Spells in which every frame lacks a part of its points, as of a driver that loses packets or a covered sensor.

    Attributes:
        every_s: (low, high) s from the end of a spell to the next one, drawn uniformly; the first comes after a random
            part of it.
        lasts_s: (low, high) s that a spell lasts, likewise.
        kinds: names from KINDS, one drawn for each spell.
        width_deg: (low, high) width of a missing sector, seen from the sensor.
        keep: share of the points that is left, of the other kinds.
    """

    every_s: NonNegativePair
    lasts_s: NonNegativePair
    kinds: _Kinds = KINDS
    width_deg: _Degrees = (40.0, 180.0)
    keep: Inside = 0.1


class PartialFrames(Stateful):
    """Draws spells for each environment, and takes points away from its frames while one lasts."""

    saved = ("_left", "_lasts", "_kind", "_offset", "_keep")

    def __init__(
        self, config: PartialFramesConfig, period_s: float, num_rays: int, num_envs: int, random: Branch
    ) -> None:
        """
        Args:
            config: how often, how long and of which kinds.
            period_s: from frame to frame (s).
            num_rays: R, of a frame.
            num_envs: environments.
            random: streams to draw from, and nobody else.
        """
        self._config, self._period_s, self._random = config, period_s, random
        device = random.counter.device
        self._all_envs = torch.arange(num_envs, device=device)
        self._kinds = torch.tensor([KINDS.index(kind) for kind in config.kinds], device=device)
        self._in_time = torch.arange(num_rays, device=device) / num_rays
        self._at_random = torch.rand(num_rays, generator=torch.Generator().manual_seed(0)).to(device)
        self._left = torch.zeros(num_envs, dtype=torch.int64, device=device)  # frames until a spell begins or ends
        self._lasts = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._kind = torch.zeros_like(self._left)
        self._offset, self._keep = torch.zeros(2, num_envs, device=device).unbind(0)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Draws when the first spell of the episodes that begin in environments (n,) comes."""
        self._random.start_episode(env_ids)
        u, part = self._random.uniform(env_ids, (2,)).unbind(1)
        self._left[env_ids] = (part * self._frames(self._config.every_s, u)).long()
        self._lasts.index_fill_(0, env_ids, False)

    def draw(self) -> None:
        """Draws for the next frame."""
        u, kind, offset, width = self._random.uniform(self._all_envs, (4,)).unbind(1)
        ends, begins = self._lasts & (self._left == 0), ~self._lasts & (self._left == 0)
        begins |= ends & (self._frames(self._config.every_s, u) == 0)
        low, high = self._config.width_deg
        kind = self._kinds[(kind * len(self._kinds)).long()]
        lost = (low + width * (high - low)) / 360.0
        keep = torch.where(kind == 0, 1.0 - lost, self._config.keep)
        self._kind, self._keep = torch.where(begins, kind, self._kind), torch.where(begins, keep, self._keep)
        self._offset = torch.where(begins | (self._kind == _WEDGE) | (self._kind == _THIN), offset, self._offset)
        self._lasts = (self._lasts & ~ends) | begins
        gap, length = self._frames(self._config.every_s, u), self._frames(self._config.lasts_s, u).clamp(min=1)
        self._left = torch.where(begins, length, torch.where(ends, gap, self._left)) - 1

    def take_away(self, ranges: torch.Tensor, directions_s: torch.Tensor, envs: slice) -> None:
        """Makes misses of the rays that are lost, in `ranges` (n, R); directions_s: (n, R, 3), sensor frame."""
        azimuth = torch.atan2(directions_s[..., 1], directions_s[..., 0]) / (2.0 * math.pi)
        kind = self._kind[envs, None]
        place = torch.where(kind == _SLICE, self._in_time, torch.where(kind == _THIN, self._at_random, azimuth))
        left = torch.remainder(place - self._offset[envs, None], 1.0) < self._keep[envs, None]
        ranges.masked_fill_(self._lasts[envs, None] & ~left, math.inf)

    def _frames(self, seconds: Sequence[float], u: torch.Tensor) -> torch.Tensor:
        """(n,) int64 frames in a time drawn from a range; `u` (n,) uniform in [0, 1)."""
        low, high = seconds
        return ((low + u * (high - low)) / self._period_s).round().long()
