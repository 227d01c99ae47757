"""Episodes that begin again shortly before a touch, so that a policy meets what it failed at more than once.

After SEA-Nav (arXiv:2603.09460), which begins episodes from states before collisions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from omniperception.common.random import Branch

Moment = dict[str, torch.Tensor]
"""(num_envs, ...) each, by name: all that makes an environment's scene at one time."""


@dataclass(frozen=True)
class CollisionReplayConfig:
    """Which episodes begin again before a touch, and how long before.

    Attributes:
        share: of the episodes that follow one with a touch; the others begin anew.
        before_s: s; an episode begins again so long before its first touch, or up to twice as long, but not before its
            own beginning.
    """

    share: float
    before_s: float

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise ValueError(
                f"collision_replay.share={self.share} must lie in (0, 1]; collision_replay=null begins all anew"
            )
        if self.before_s <= 0:
            raise ValueError(f"collision_replay.before_s={self.before_s} must be positive")


class CollisionReplay:
    """Keeps the scenes of all environments from shortly before their first touches.

    Attributes:
        kept: (num_envs,) bool: whose episode has had a touch, so that its scene before it is kept.
    """

    def __init__(
        self, config: CollisionReplayConfig, control_dt: float, random: Branch, now: Callable[[], Moment]
    ) -> None:
        """
        Args:
            config: which episodes, and how long before.
            control_dt: s.
            random: streams to draw from.
            now: gives copies of the present scenes.
        """
        self._share, self._every = config.share, max(round(config.before_s / control_dt), 1)
        self._random, self._now = random, now
        self._older, self._newer, self._before = now(), now(), now()
        any_of_them = next(iter(self._older.values()))
        self.kept = torch.zeros(len(any_of_them), dtype=torch.bool, device=any_of_them.device)

    def follow(self, step_count: int, touching: torch.Tensor) -> None:
        """Takes in a control step: its number, and who touches an obstacle (num_envs,) bool at its end."""
        touched = (touching & ~self.kept).nonzero().flatten()
        if len(touched):
            _copy(self._before, touched, _rows(self._older, touched))
            self.kept.index_fill_(0, touched, True)
        if step_count % self._every == 0:
            for older, newer, now in zip(self._older.values(), self._newer.values(), self._now().values(), strict=True):
                older.copy_(newer)
                newer.copy_(now)

    def draw(self, env_ids: torch.Tensor) -> tuple[torch.Tensor, Moment]:
        """Which of the environments (n,) that have ended begin again before their touch (m,), and where (m, ...)."""
        self._random.start_episode(env_ids)
        again = env_ids[self.kept[env_ids] & (self._random.uniform(env_ids) < self._share)]
        return again, _rows(self._before, again)

    def begin(self, env_ids: torch.Tensor) -> None:
        """Forgets what was before the episodes of environments (n,) that have just begun."""
        self.kept.index_fill_(0, env_ids, False)
        begun = _rows(self._now(), env_ids)
        _copy(self._older, env_ids, begun)
        _copy(self._newer, env_ids, begun)

    def state_dict(self) -> dict:
        scenes = {"older": self._older, "newer": self._newer, "before": self._before}
        copies = {name: {key: x.clone() for key, x in scene.items()} for name, scene in scenes.items()}
        return {"kept": self.kept.clone(), **copies}

    def load_state_dict(self, state: dict) -> None:
        self.kept.copy_(state["kept"])
        for scene, saved in ((self._older, "older"), (self._newer, "newer"), (self._before, "before")):
            for key, value in scene.items():
                value.copy_(state[saved][key])


def _rows(scene: Moment, env_ids: torch.Tensor) -> Moment:
    return {name: value[env_ids] for name, value in scene.items()}


def _copy(scene: Moment, env_ids: torch.Tensor, rows: Moment) -> None:
    for name, value in scene.items():
        value[env_ids] = rows[name]
