"""Runs a policy for a number of whole episodes and counts what happened in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict

from omniperception.evaluation.statistics import wilson
from omniperception.task.env import OmniEnv
from omniperception.task.metrics import OUTCOMES

Policy = Callable[[TensorDict], torch.Tensor]
"""From observations to actions (num_envs, num_actions), without exploration noise."""


@dataclass(frozen=True)
class Episodes:
    """What happened in each episode; tensors are (num_episodes,), ordered by environment and then by time.

    Attributes:
        length_s: duration (s).
        outcome: int64 index into `omniperception.task.metrics.OUTCOMES`: how it ended.
        contacts: int64 number of times that the robot began to touch obstacles.
        velocity_error: mean error of the horizontal velocity (m/s).
        free_velocity_error: the same over the moments with no obstacle near, NaN in an episode without such a
            moment; None where the run does not measure distances to obstacles.
        free_s: time with no obstacle near (s); None as above.
        yaw_rate_error: mean error of the yaw rate (rad/s).
        has_goal: whether the commands lead to a goal.
        per_env: episodes of each environment.
        us_per_env_step: wall time by stage in microseconds per environment and control step; `policy` is the
            network.
    """

    length_s: torch.Tensor
    outcome: torch.Tensor
    contacts: torch.Tensor
    velocity_error: torch.Tensor
    free_velocity_error: torch.Tensor | None
    free_s: torch.Tensor | None
    yaw_rate_error: torch.Tensor
    has_goal: bool
    per_env: int
    us_per_env_step: dict[str, float]

    def __len__(self) -> int:
        return len(self.length_s)

    def ended(self, name: str) -> torch.Tensor:
        """(num_episodes,) bool: which episodes ended for this reason, one of OUTCOMES."""
        return self.outcome == OUTCOMES.index(name)

    @property
    def collided(self) -> torch.Tensor:
        """(num_episodes,) bool: at least one contact with an obstacle."""
        return self.contacts > 0

    @property
    def success(self) -> torch.Tensor:
        """(num_episodes,) bool: reached the goal or, without a goal, the time limit. Touches do not count."""
        return self.ended("goal" if self.has_goal else "time_out")

    def summary(self) -> dict:
        """Rates with 95 % Wilson intervals, mean errors and times, as plain numbers."""
        rates = {
            "success": self.success,
            "success_untouched": self.success & ~self.collided,
            "collision": self.collided,
            "fall": self.ended("fall"),
            "time_out": self.ended("time_out"),
            "diverged": self.ended("diverged"),
        }
        if self.has_goal:
            rates["goal"] = self.ended("goal")
        return {
            "episodes": len(self),
            "episodes_per_env": self.per_env,
            "success_means": "goal reached" if self.has_goal else "time limit reached",
            "rates": {name: _rate(happened) for name, happened in rates.items()},
            "mean_length_s": float(self.length_s.mean()),
            "contacts_per_minute": 60.0 * float(self.contacts.sum() / self.length_s.sum()),
            "velocity_error_m_s": _weighted(self.velocity_error, self.length_s),
            "free_velocity_error_m_s": _weighted(self.free_velocity_error, self.free_s),
            "yaw_rate_error_rad_s": _weighted(self.yaw_rate_error, self.length_s),
            "us_per_env_step": dict(self.us_per_env_step),
        }


def run_episodes(
    env: OmniEnv, policy: Policy, num_episodes: int, on_step: Callable[[], None] | None = None
) -> Episodes:
    """Runs the first ceil(num_episodes / num_envs) episodes of every environment.

    Taking equally many episodes from each environment keeps short ones from being over-represented, as they
    would be among the first to finish.

    Args:
        env: freshly built: every environment at the start of an episode.
        policy: from observations to actions.
        num_episodes: at least so many episodes are run.
        on_step: called after every control step, in which environments that ended have already been reset.
    """
    if num_episodes < 1:
        raise ValueError(f"episodes={num_episodes} must be at least 1")
    if bool(env.episode_length_buf.any()):
        raise ValueError("run_episodes needs a freshly built environment; this one has already been stepped")
    tally = _Tally(env, math.ceil(num_episodes / env.num_envs))
    clock = _StageClock(env)
    with torch.no_grad():
        observations = env.get_observations()
        while not tally.complete:
            with env.timer.stage("policy"):
                actions = policy(observations)
            observations, _, _, extras = env.step(actions)
            tally.record()
            clock.record(extras)
            if on_step is not None:
                on_step()
    return tally.episodes(clock.us_per_env_step())


def table(summary: dict) -> str:
    """A summary as a table for the console."""
    lines = [f"{summary['episodes']} episodes, success: {summary['success_means']}"]
    lines += [_rate_line(name, rate) for name, rate in summary["rates"].items()]
    for key, label, unit in _FIGURES:
        if summary[key] is not None:
            lines.append(f"  {label:<28}{summary[key]:8.3f} {unit}")
    times = sorted(summary["us_per_env_step"].items(), key=lambda item: -item[1])
    lines.append("  time per environment step    " + ", ".join(f"{name} {spent:.1f}" for name, spent in times) + " us")
    return "\n".join(lines)


_FIGURES = (
    ("velocity_error_m_s", "velocity error", "m/s"),
    ("free_velocity_error_m_s", "velocity error, nothing near", "m/s"),
    ("yaw_rate_error_rad_s", "yaw rate error", "rad/s"),
    ("contacts_per_minute", "contacts", "per minute"),
    ("mean_length_s", "episode length", "s"),
)


class _Tally:
    """Adds up the running episode of every environment and files it when it ends."""

    def __init__(self, env: OmniEnv, per_env: int) -> None:
        self._env, self._per_env = env, per_env
        self._index = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)
        self._sums = torch.zeros(env.num_envs, 6, dtype=torch.float64, device=env.device)
        self._filed = torch.zeros(env.num_envs, per_env, 6, dtype=torch.float64, device=env.device)
        self._outcome = torch.zeros(env.num_envs, per_env, dtype=torch.int64, device=env.device)
        self._was_touching = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._knows_free = True

    @property
    def complete(self) -> bool:
        return bool((self._index >= self._per_env).all())

    def record(self) -> None:
        """Takes in the control step that has just been done."""
        env = self._env
        self._knows_free = env.free is not None
        free = env.free if env.free is not None else torch.zeros_like(env.done)
        began = env.contacts & ~self._was_touching
        step = (
            torch.ones_like(free),
            env.velocity_error,
            env.yaw_rate_error,
            free,
            env.velocity_error * free,
            began,
        )
        self._sums += torch.stack([value.double() for value in step], 1)
        filed = (env.done & (self._index < self._per_env)).nonzero().flatten()
        slot = self._index[filed]
        self._filed[filed, slot] = self._sums[filed]
        self._outcome[filed, slot] = torch.stack([env.outcomes[name] for name in OUTCOMES], 1)[filed].int().argmax(1)
        self._index += env.done
        self._sums *= ~env.done[:, None]
        self._was_touching = env.contacts & ~env.done

    def episodes(self, us_per_env_step: dict[str, float]) -> Episodes:
        steps, velocity, yaw_rate, free, free_velocity, began = self._filed.flatten(0, 1).cpu().unbind(1)
        dt = self._env.control_dt
        return Episodes(
            length_s=steps * dt,
            outcome=self._outcome.flatten().cpu(),
            contacts=began.long(),
            velocity_error=velocity / steps,
            free_velocity_error=free_velocity / free if self._knows_free else None,
            free_s=free * dt if self._knows_free else None,
            yaw_rate_error=yaw_rate / steps,
            has_goal=self._env.command.reached(self._env.kinematics) is not None,
            per_env=self._per_env,
            us_per_env_step=us_per_env_step,
        )


class _StageClock:
    """Sums the environment's stage times; a step with a log has moved its own into the log."""

    def __init__(self, env: OmniEnv) -> None:
        self._env, self._steps = env, 0
        self._us: dict[str, float] = {}
        env.timer.drain()

    def record(self, extras: dict) -> None:
        self._steps += 1
        for stage, seconds in self._env.timer.drain().items():
            self._add(stage, 1e6 * seconds / self._env.num_envs)
        for key, us in extras.get("log", {}).items():
            if key.startswith(_TIME) and key.endswith(_UNIT):
                self._add(key[len(_TIME) : -len(_UNIT)], us * self._env.config.log_interval)

    def us_per_env_step(self) -> dict[str, float]:
        return {stage: us / self._steps for stage, us in self._us.items()}

    def _add(self, stage: str, us: float) -> None:
        self._us[stage] = self._us.get(stage, 0.0) + us


_TIME, _UNIT = "Time/", "_us_per_env_step"


def _rate(happened: torch.Tensor) -> dict:
    count = int(happened.sum())
    low, high = wilson(count, len(happened))
    return {"count": count, "rate": count / len(happened), "low": low, "high": high}


def _rate_line(name: str, rate: dict) -> str:
    interval = f"[{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]"
    return f"  {name.replace('_', ' '):<28}{100 * rate['rate']:7.1f} %  {interval:<14} {rate['count']}"


def _weighted(mean: torch.Tensor | None, weight: torch.Tensor | None) -> float | None:
    """Mean of per-episode means, weighted by their durations; None where nothing was measured."""
    if mean is None or not bool((weight > 0).any()):
        return None
    return float(torch.where(weight > 0, mean * weight, 0.0).sum() / weight.sum())
