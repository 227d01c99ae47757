"""The avoidance velocity in the environments of a task: from LiDAR frames and true obstacles to V_avoid."""

from __future__ import annotations

from collections.abc import Collection

import torch

from omniperception.avoidance.sector_motion import NEARNESS_RANGE, encode, nothing_near
from omniperception.avoidance.true_sectors import TrueSectors
from omniperception.avoidance.velocity import (
    AVOIDANCE_TARGET,
    MOTION_TARGET,
    SECTOR_TARGET,
    AvoidanceConfig,
    avoidance_velocity,
)
from omniperception.common.stateful import Stateful
from omniperception.scene import ObstacleField, ObstaclesConfig


class Avoidance(Stateful):
    """V_avoid of all environments: `add_frame` at each LiDAR frame, `choose` at each step, `reset` at each reset.

    It exists only where a term or a supervised network reads it, and holds only what they read.

    Attributes:
        true_sectors: measures `motion`; None where V_avoid is the paper's.
        velocity: (num_envs, 2) m/s in the yaw-aligned frame: V_avoid; 0 before an episode's first frame.
        sector_distance: (num_envs, num_sectors) horizontal distance (m) from the base to the nearest obstacle hit at
            the newest frame, without noise, in the yaw-aligned frame; written by the LiDAR. None if no term reads it.
        motion: (num_envs, num_sectors, 3) distance (m) and velocity (m/s, yaw-aligned) of the nearest true obstacle
            that the LiDAR has seen, at the newest frame; None where V_avoid is the paper's.
        risk: (num_envs, K) of each candidate velocity, from `motion`; None when no V_avoid follows from it.
    """

    saved, buffers = ("velocity", "motion", "risk"), ("sector_distance",)

    def __init__(
        self,
        config: AvoidanceConfig,
        num_envs: int,
        device: torch.device,
        max_distance: float,
        obstacles: ObstaclesConfig,
        field: ObstacleField | None,
        reads_velocity: bool,
    ) -> None:
        """
        Args:
            config: settings.
            num_envs, device: of all tensors.
            max_distance: distance (m) of a sector without an obstacle.
            obstacles: every obstacle.
            field: where they are; None without any.
            reads_velocity: whether V_avoid and the sector distances are read, beside `motion`.
        """
        self.config, self._max_distance = config, max_distance
        self.true_sectors: TrueSectors | None = None
        self.velocity = torch.zeros(num_envs, 2, device=device)
        self.sector_distance: torch.Tensor | None = None
        self.motion: torch.Tensor | None = None
        self.risk: torch.Tensor | None = None
        if reads_velocity:
            self.sector_distance = torch.full((num_envs, config.num_sectors), max_distance, device=device)
        if config.risk is not None:
            self.true_sectors = TrueSectors(config.num_sectors, obstacles, field, num_envs, device)
            self.motion = nothing_near(num_envs, config.num_sectors, device)
        if config.risk is not None and reads_velocity:
            self._candidates = config.risk.candidates(device)
            self.risk = torch.zeros(num_envs, config.risk.num_candidates, device=device)

    @property
    def obstacle_names(self) -> tuple[str, ...]:
        """Geoms of the obstacles whose sightings `add_frame` takes, in its order."""
        return () if self.true_sectors is None else self.true_sectors.names

    def add_frame(self, base_pos_w: torch.Tensor, yaw: torch.Tensor, seen: torch.Tensor | None) -> None:
        """Takes in a frame, whose sector distances are already there.

        Args:
            base_pos_w: (num_envs, 3) m, where the robots are.
            yaw: (num_envs,) rad.
            seen: (num_envs, O) bool: obstacles that a ray has hit lately; None without obstacles.
        """
        if self.true_sectors is None:
            assert self.sector_distance is not None  # without a velocity risk only V_avoid is read
            self.velocity = avoidance_velocity(self.sector_distance, self.config)
            return
        self.motion = self.true_sectors.measure(base_pos_w, yaw, seen)
        if self.risk is not None:
            assert self.config.risk is not None
            self.risk = self.config.risk.risk(self.motion, self._candidates)

    def choose(self, command: torch.Tensor) -> None:
        """V_avoid under commanded velocities (num_envs, 2) m/s; the paper's does not depend on them."""
        if self.risk is not None:
            assert self.config.risk is not None
            self.velocity = self.config.risk.avoidance(self.risk, command, self._candidates)

    def no_obstacle_near(self) -> torch.Tensor | None:
        """(num_envs,) bool: no obstacle within the threshold in any sector; None where sectors are not measured."""
        return None if self.sector_distance is None else (self.sector_distance >= self.config.threshold).all(1)

    def targets(self, names: Collection[str]) -> dict[str, torch.Tensor]:
        """Targets among SECTOR_TARGET, AVOIDANCE_TARGET and MOTION_TARGET that are in `names`; (num_envs, ...)."""
        targets: dict[str, torch.Tensor] = {}
        if SECTOR_TARGET in names:
            assert self.sector_distance is not None  # it is supervised, so V_avoid is read
            targets[SECTOR_TARGET] = (1.0 - self.sector_distance / NEARNESS_RANGE).clamp(min=0.0)
        if AVOIDANCE_TARGET in names:
            targets[AVOIDANCE_TARGET] = self.velocity
        if MOTION_TARGET in names:
            assert self.motion is not None  # only a velocity risk supervises it
            targets[MOTION_TARGET] = encode(self.motion).flatten(1)
        return targets

    def reset(self, env_ids: torch.Tensor) -> None:
        """Clears avoidance velocity and sector distances of environments (n,)."""
        self.velocity = self.velocity.index_fill(0, env_ids, 0.0)
        if self.sector_distance is not None:
            self.sector_distance.index_fill_(0, env_ids, self._max_distance)
        if self.motion is not None:
            nothing = nothing_near(len(env_ids), self.config.num_sectors, self.motion.device)
            self.motion = self.motion.index_copy(0, env_ids, nothing)
        if self.risk is not None:
            self.risk = self.risk.index_fill(0, env_ids, 0.0)
