"""Ways of the robots through their trials, and the scenes of the trials, for pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from omniperception.common.random import TrialRandom
from omniperception.env.env import OmniEnv
from omniperception.scene.obstacle_field import PARKED_HEIGHT
from omnirobot.common.errors import naming

PERIOD_S = 0.1
"""Time between two points of a way."""
KEPT_SCENES = 16
"""Trials, the first ones, whose obstacles are kept."""


@dataclass(frozen=True)
class Tracks:
    """Ways and scenes of trials; lists are in the order of the trials' numbers.

    Attributes:
        xy: one (T, 2) per trial: the base's position (m, environment frame), at the start, every PERIOD_S and at the
            end.
        goal: (num_trials, 2) m; None without goals.
        contact: (num_trials, 2) m: where the base was at the first touch; NaN without one.
        parts: (min(num_trials, KEPT_SCENES), P, 7): the obstacles' footprints at the start, see `footprints`.
    """

    xy: list[torch.Tensor]
    goal: torch.Tensor | None
    contact: torch.Tensor
    parts: torch.Tensor

    def save(self, path: Path) -> None:
        """Writes them as float32 to an .npz file."""
        arrays = {"points": torch.cat(self.xy), "counts": torch.tensor([len(way) for way in self.xy])}
        arrays |= {"contact": self.contact, "parts": self.parts} | ({} if self.goal is None else {"goal": self.goal})
        plain = {name: value.numpy() for name, value in arrays.items()}
        with naming(path), open(path, "wb") as file:
            np.savez_compressed(file, **plain)  # type: ignore[arg-type]  # keywords are arrays

    @classmethod
    def load(cls, path: Path) -> Tracks:
        """What `save` wrote."""
        with np.load(path) as file:
            arrays = {name: torch.from_numpy(file[name]) for name in file.files}
        xy = list(arrays["points"].split(arrays["counts"].tolist()))
        return cls(xy, arrays.get("goal"), arrays["contact"], arrays["parts"])


class TrackRecorder:
    """Follows the first `num_trials` trials."""

    def __init__(self, env: OmniEnv, num_trials: int) -> None:
        assert isinstance(env.random, TrialRandom)  # or there is no tally either
        self._env, self._trial, self._count = env, env.random.trial, num_trials
        self._every = max(1, round(PERIOD_S / env.control_dt))
        self._points: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._goal = torch.zeros(num_trials, 2, device=env.device)
        self._contact = torch.full((num_trials, 2), torch.nan, device=env.device)
        self._parts = torch.zeros(min(num_trials, KEPT_SCENES), *footprints(env).shape[1:], device=env.device)

    def begin(self, fresh: torch.Tensor) -> None:
        """Takes in the scenes of environments (n,) in which trials are about to begin."""
        env, fresh = self._env, fresh[self._trial[fresh] < self._count]
        trial = self._trial[fresh]
        self._points.append((trial.clone(), env.state.kinematics.base_pos_w[fresh, :2].clone()))
        if env.command.goal_w is not None:
            self._goal[trial] = env.command.goal_w[fresh]
        kept = trial < len(self._parts)
        if bool(kept.any()):
            self._parts[trial[kept]] = footprints(env)[fresh[kept]]

    def record(self) -> None:
        """Takes in the control step that has just been done, before finished environments are reset."""
        env, running = self._env, self._trial < self._count
        xy = env.state.kinematics.base_pos_w[:, :2]
        ids = (running & (env.done | (env.episode_length_buf % self._every == 0))).nonzero().flatten()
        self._points.append((self._trial[ids], xy[ids].clone()))
        touched = (running & env.contacts).nonzero().flatten()
        before = self._contact[self._trial[touched]]
        self._contact[self._trial[touched]] = torch.where(before.isnan(), xy[touched], before)

    def tracks(self) -> Tracks:
        """The recorded tracks."""
        trial = torch.cat([ids for ids, _ in self._points])
        points = torch.cat([xy for _, xy in self._points])
        order = trial.argsort(stable=True)
        counts = trial.bincount(minlength=self._count)
        return Tracks(
            xy=[way.cpu() for way in points[order].split(counts.tolist())],
            goal=None if self._env.command.goal_w is None else self._goal.cpu(),
            contact=self._contact.cpu(),
            parts=self._parts.cpu(),
        )


def footprints(env: OmniEnv) -> torch.Tensor:
    """(num_envs, P, 7) float32 what the obstacles' parts look like from above, at present.

    The numbers are x, y (m, environment frame), yaw (rad), half length and half width (m; a negative width: a circle
    whose radius is the half length), the height (m) of the lowest point above the ground and the speed (m/s). Parts
    that are not there are NaN.
    """
    field = env.obstacles
    if field is None:
        return torch.zeros(env.num_envs, 0, 7, device=env.device)
    pose = (field.pos_w[..., :2], field.yaw[..., None])
    rest = torch.stack((field.bottom_above_ground(), field.velocity_w.norm(dim=-1)), -1)
    there = field.pos_w[..., 2:] > PARKED_HEIGHT / 2
    return torch.where(there, torch.cat((*pose, field.outline, rest), -1), torch.nan).float()
