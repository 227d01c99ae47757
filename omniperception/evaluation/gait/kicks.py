"""Single kicks of a walking robot: which sizes and directions it survives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from omniperception.common.rotations import rotate_yaw
from omniperception.env.env import OmniEnv, Policy
from omniperception.evaluation.trials.episodes import run_episodes
from omniperception.evaluation.trials.statistics import rate
from omniperception.evaluation.trials.tally import trial_numbers
from omnirobot.common.figures import new_figure, save_figure

AFTER_S, WATCHED_S = 3.0, 5.0
"""Time (s) of a kick, and for how long falls are counted after it."""


class Kicks:
    """In place of `Pushes`: one kick in every trial, whose size and direction follow from the trial's number."""

    def __init__(self, env: OmniEnv, change: torch.Tensor) -> None:
        """
        Args:
            env: of trials.
            change: (num_trials, 2) m/s added to the base's horizontal velocity, yaw-aligned frame.
        """
        self._env, self._trial = env, trial_numbers(env)
        self._change = change.to(env.device)
        self._at = round(AFTER_S / env.control_dt)

    def advance(self) -> None:
        """Kicks the robots whose time it is, before the physics of a control step."""
        env = self._env
        due = (env.episode_length_buf == self._at) & (self._trial < len(self._change))
        change = rotate_yaw(env.state.kinematics.yaw, self._change[self._trial.clamp(max=len(self._change) - 1)])
        velocity = env.sim.qvel[:, :2]
        velocity.copy_(torch.where(due[:, None], velocity + change.to(velocity.dtype), velocity))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Nothing is drawn."""


@dataclass(frozen=True)
class KickResults:
    """What became of kicked robots; (num_trials,) each.

    Attributes:
        speed: size of the kick (m/s).
        kicked: bool: was still walking when the kick was due.
        survived: bool: was kicked and did not fall within WATCHED_S.
    """

    speed: torch.Tensor
    kicked: torch.Tensor
    survived: torch.Tensor

    def rate(self, speed: float) -> dict | None:
        """Share of the kicks of one size that was survived, with its interval; None where no robot still walked."""
        wanted = self.kicked & (self.speed == speed)
        return rate(self.survived[wanted]) if bool(wanted.any()) else None

    def shares(self, speeds: Sequence[float], num_bearings: int) -> torch.Tensor:
        """(len(speeds), num_bearings) share survived by size and direction."""
        of = torch.arange(len(self.speed)) % num_bearings
        there = [[self.kicked & (self.speed == v) & (of == b) for b in range(num_bearings)] for v in speeds]
        return torch.tensor([[float(self.survived[one].double().mean()) for one in row] for row in there])


def kick(env: OmniEnv, policy: Policy, speeds: Sequence[float], num_bearings: int, repeats: int) -> KickResults:
    """Kicks a robot in each direction with each size.

    Args:
        env: freshly built with `EnvConfig.trials`, without pushes; episodes of AFTER_S + WATCHED_S.
        policy: from observations to actions.
        speeds: sizes (m/s).
        num_bearings: directions, evenly around.
        repeats: trials of each.
    """
    bearing = (2 * math.pi / num_bearings * torch.arange(num_bearings)).repeat(len(speeds) * repeats)
    speed = torch.tensor(list(speeds)).repeat_interleave(num_bearings).repeat(repeats)
    change = speed[:, None] * torch.stack((bearing.cos(), bearing.sin()), 1)
    env.pushes = Kicks(env, change)  # type: ignore[assignment]  # stands in for them
    episodes = run_episodes(env, policy, len(speed))
    kicked = episodes.length_s >= AFTER_S
    return KickResults(speed, kicked, kicked & episodes.ended("time_out"))


def draw_kicks(results: KickResults, speeds: Sequence[float], num_bearings: int, path: Path) -> None:
    """Shares survived by direction, seen from above with ahead up, a line for each size."""
    figure = new_figure(4.6, 4.4)
    axis: Any = figure.add_subplot(projection="polar")
    axis.set_theta_zero_location("N")
    bearing = 2 * math.pi / num_bearings * torch.arange(num_bearings + 1)
    for speed, shares in zip(speeds, results.shares(speeds, num_bearings), strict=True):
        closed = torch.cat((shares, shares[:1]))
        axis.plot(bearing.tolist(), (100 * closed).tolist(), marker="o", markersize=3, label=f"{speed:g} m/s")
    axis.set_ylim(0, 100)
    axis.set_xticks([k * math.pi / 2 for k in range(4)], ["ahead", "left", "back", "right"])
    axis.set_title("kicks survived, %, by direction of the change of velocity", fontsize=9)
    axis.legend(loc="lower left", fontsize=7)
    save_figure(figure, path)
