"""Curriculum over terrain: environments move to harder or easier tiles by how far their robots walked."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch

from omniperception.common.random import EnvRandom
from omniperception.common.stateful import Stateful
from omniperception.env.kinematics import Kinematics
from omniperception.scene.ground import Ground

if TYPE_CHECKING:
    from omniperception.scene.tiled_terrain import TiledTerrainConfig

_MIN_SPEED = 1e-3
"""Commands slower than this (m/s) have no direction."""


class TerrainLevels(Stateful):
    """Follows each environment's episode and chooses the tile of its next one; see `TerrainCurriculumConfig`.

    Attributes:
        walked: (num_envs,) distance (m) along the commanded direction in this episode.
        commanded: (num_envs,) distance (m) that was commanded.
        reach: (num_envs,) largest horizontal distance (m) from where the episode started.
    """

    saved = ("walked", "commanded", "reach", "_steps", "_start")  # the levels are the ground's

    def __init__(
        self, ground: Ground, random: EnvRandom, control_dt: float, max_episode_length: int, any_tile: bool = False
    ) -> None:
        """
        Args:
            ground: the tiles.
            random: draws of the environments.
            control_dt: s.
            max_episode_length: control steps.
            any_tile: whether each episode draws its tile among all, without a curriculum.
        """
        self._ground, self._random, self._any_tile = ground, random, any_tile
        self._dt, self._max_steps = control_dt, max_episode_length
        num_envs, device = len(ground.level), ground.level.device
        self.walked, self.commanded, self.reach, self._steps = torch.zeros(4, num_envs, device=device).unbind(0)
        self._start = torch.zeros(num_envs, 2, device=device)

    def record(self, kinematics: Kinematics, command: torch.Tensor, healthy: torch.Tensor) -> None:
        """Takes in a control step.

        Args:
            kinematics: state at its end.
            command: (num_envs, 3) v_x, v_y (m/s) and yaw rate in the base frame.
            healthy: (num_envs,) bool: whose physics is sound; the others have walked nowhere.
        """
        speed = command[:, :2].norm(dim=1)
        along = (kinematics.base_lin_vel_yaw * command[:, :2]).sum(1) / speed.clamp(min=_MIN_SPEED)
        self.walked += torch.where((speed > _MIN_SPEED) & healthy, along, 0.0) * self._dt
        self.commanded += speed * self._dt
        self._steps += 1.0
        from_start = (kinematics.base_pos_w[:, :2] - self._start).norm(dim=1)
        torch.maximum(self.reach, torch.where(healthy, from_start, 0.0), out=self.reach)

    def start(self, env_ids: torch.Tensor, xy_w: torch.Tensor, complete: torch.Tensor | None = None) -> None:
        """Begins new episodes and chooses their tiles.

        Args:
            env_ids: (n,) environments whose episodes begin.
            xy_w: (n, 2) m, where their robots stand.
            complete: (n,) bool: whether the last episode ended as planned, so that it commanded no more; None before
                the first episode.
        """
        config, ground = self._ground.config, self._ground
        draw = self._random.uniform(env_ids)
        if self._any_tile:
            ground.column[env_ids] = (self._random.uniform(env_ids) * config.columns).long()
        if self._any_tile or config.curriculum is None:
            level = (draw * config.levels).long()
        elif complete is None:
            level = (draw * (config.curriculum.start_level + 1)).long()
        else:
            level = (ground.level[env_ids] + self.steps_up(env_ids, complete)).clamp(min=0)
            level = torch.where(level < config.levels, level, (draw * config.levels).long())
        ground.move(env_ids, level)
        self._start[env_ids] = xy_w
        for total in (self.walked, self.commanded, self.reach, self._steps):
            total.index_fill_(0, env_ids, 0.0)

    def steps_up(self, env_ids: torch.Tensor, complete: torch.Tensor) -> torch.Tensor:
        """(n,) int64: 1 for environments that move up a level, -1 for those that move down; see `start`."""
        config = cast("TiledTerrainConfig", self._ground.config)  # without a curriculum, as on maps, levels are drawn
        curriculum = config.curriculum
        assert curriculum is not None
        walked, commanded, reach, steps = (
            values[env_ids] for values in (self.walked, self.commanded, self.reach, self._steps)
        )
        rest = (self._max_steps / steps.clamp(min=1.0)).clamp(min=1.0)
        commanded = torch.where(complete, commanded, commanded * rest)
        far = reach > config.tile_size / 2
        well = (reach > config.platform / 2) & (walked >= curriculum.up_share * commanded)
        up = far | well
        return up.long() - (~up & (walked < curriculum.down_share * commanded)).long()

    def report(self) -> dict[str, float]:
        """Mean levels for the log."""
        kinds = self._ground.mean_level_by_kind()
        return {
            "Metrics/terrain_level": self._ground.mean_level(),
            **{f"Terrain/level_{kind}": level for kind, level in kinds.items()},
        }
