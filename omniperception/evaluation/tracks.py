"""Ways of the robots through their episodes, for pictures."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from omniperception.env.env import OmniEnv

PERIOD_S = 0.1
"""Time between two points of a way."""


@dataclass(frozen=True)
class Tracks:
    """Tracks of the episodes for a picture; lists are ordered by environment and then by time.

    Attributes:
        xy: one (T, 2) per episode: the base's position (m, environment frame) every PERIOD_S and at the end.
        goal: (num_episodes, 2) m; None without goals.
        contact: (num_episodes, 2) m: where the base was at the first touch; NaN without one.
        obstacles: (num_episodes, num_placed, 4): x, y, z (m) and yaw (rad) of the placed obstacles at the start.
    """

    xy: list[torch.Tensor]
    goal: torch.Tensor | None
    contact: torch.Tensor
    obstacles: torch.Tensor


class TrackRecorder:
    """Follows the first `per_env` episodes of every environment."""

    def __init__(self, env: OmniEnv, per_env: int) -> None:
        self._env, self._per_env = env, per_env
        self._every = max(1, round(PERIOD_S / env.control_dt))
        shape = env.num_envs, per_env
        self._episode = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)
        self._points: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._goal = torch.zeros(*shape, 2, device=env.device)
        self._contact = torch.full((*shape, 2), torch.nan, device=env.device)
        num_placed = env.sim.mocap_pos.shape[1]
        self._obstacles = torch.zeros(*shape, num_placed, 4, device=env.device)

    def record(self) -> None:
        """Takes in the control step that has just been done, before finished environments are reset."""
        env = self._env
        running = self._episode < self._per_env
        xy = env.state.kinematics.base_pos_w[:, :2]
        first = (running & (env.episode_length_buf == 1)).nonzero().flatten()
        if len(first):
            self._keep_scene(first, self._episode[first])
        due = running & (env.done | (env.episode_length_buf % self._every == 1))
        ids = due.nonzero().flatten()
        self._points.append((ids * self._per_env + self._episode[ids], xy[ids].clone()))
        touched = (running & env.contacts).nonzero().flatten()
        slot = self._episode[touched]
        before = self._contact[touched, slot]
        self._contact[touched, slot] = torch.where(before.isnan(), xy[touched], before)
        self._episode += env.done

    def tracks(self) -> Tracks:
        """The recorded tracks."""
        episode = torch.cat([ids for ids, _ in self._points])
        points = torch.cat([xy for _, xy in self._points])
        order = episode.argsort(stable=True)
        counts = episode.bincount(minlength=self._env.num_envs * self._per_env)
        return Tracks(
            xy=[way.cpu() for way in points[order].split(counts.tolist())],
            goal=None if self._env.command.goal_w is None else self._goal.flatten(0, 1).cpu(),
            contact=self._contact.flatten(0, 1).cpu(),
            obstacles=self._obstacles.flatten(0, 1).cpu(),
        )

    def _keep_scene(self, env_ids: torch.Tensor, slot: torch.Tensor) -> None:
        env = self._env
        if env.command.goal_w is not None:
            self._goal[env_ids, slot] = env.command.goal_w[env_ids]
        w, z = env.sim.mocap_quat[env_ids, :, 0], env.sim.mocap_quat[env_ids, :, 3]
        yaw = 2 * torch.atan2(z, w)
        self._obstacles[env_ids, slot] = torch.cat((env.sim.mocap_pos[env_ids], yaw[..., None]), -1).float()
