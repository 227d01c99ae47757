"""Runs a policy for a number of whole episodes and measures what happens in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict

from omniperception.env.env import OmniEnv
from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.clearance import Clearance
from omniperception.evaluation.statistics import quantiles, rate
from omniperception.evaluation.tracks import TrackRecorder, Tracks

Policy = Callable[[TensorDict], torch.Tensor]
"""From observations to actions (num_envs, num_actions), without exploration noise."""

CLEARANCE_CAP = 1.0
"""Clearances (m) beyond this are reported as this."""
_GRAVITY = 9.81


@dataclass(frozen=True)
class Episodes:
    """Outcomes of episodes; tensors are (num_episodes,), ordered by environment and then by time.

    Attributes:
        length_s: duration (s).
        outcome: int64 index into `omniperception.env.metrics.OUTCOMES`: how it ended.
        contacts: int64 number of times that the robot began to touch obstacles.
        first_contact_s: time (s) of the first touch, infinite without one.
        clearance: smallest distance (m) in space between any link and any obstacle, at the end of every control step;
            0 in an episode with a touch, CLEARANCE_CAP where nothing came nearer; None without obstacles.
        energy: sum over joints and control steps of |torque * joint velocity| * dt (J), the torque of the last physics
            step of each control step.
        path: length (m) of the base's horizontal way.
        velocity_error: mean error of the horizontal velocity (m/s) against the task's command.
        free_velocity_error: the same over the moments with no obstacle near, NaN in an episode without such a
            moment; None where the run does not measure distances to obstacles.
        free_s: time with no obstacle near (s); None as above.
        yaw_rate_error: mean error of the yaw rate (rad/s).
        has_goal: whether the commands lead to a goal.
        weight: of the robot (N).
        per_env: episodes of each environment.
        us_per_env_step: wall time by stage in microseconds per environment and control step; `policy` is the
            network, `measuring` what is measured here.
        tracks: ways of the robots, where asked for.
    """

    length_s: torch.Tensor
    outcome: torch.Tensor
    contacts: torch.Tensor
    first_contact_s: torch.Tensor
    clearance: torch.Tensor | None
    energy: torch.Tensor
    path: torch.Tensor
    velocity_error: torch.Tensor
    free_velocity_error: torch.Tensor | None
    free_s: torch.Tensor | None
    yaw_rate_error: torch.Tensor
    has_goal: bool
    weight: float
    per_env: int
    us_per_env_step: dict[str, float]
    tracks: Tracks | None = None

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

    @property
    def verdict(self) -> list[str]:
        """One of VERDICTS for each episode."""
        words = []
        for succeeded, touched, outcome in zip(self.success, self.collided, self.outcome, strict=True):
            if succeeded:
                words.append("success, touched" if touched else "success")
            else:
                words.append(OUTCOMES[outcome].replace("_", " "))
        return words

    def summary(self) -> dict:
        """Rates with 95 % Wilson intervals, means and quantiles, as plain numbers.

        `rates` lets a trial go on after a touch, as the paper does; `rates_to_first_contact` ends it there, so that
        its rates add up to one.
        """
        untouched, reached = ~self.collided, self.success
        falls, time_outs = self.ended("fall"), self.ended("time_out")
        rates = {
            "success": reached,
            "success_untouched": reached & untouched,
            "collision": self.collided,
            "fall": falls,
            "time_out": time_outs,
            "diverged": self.ended("diverged"),
        }
        to_first_contact = {"success": reached, "fall": falls, "diverged": self.ended("diverged")}
        if self.has_goal:
            to_first_contact["time_out"] = time_outs
        to_first_contact = {name: happened & untouched for name, happened in to_first_contact.items()}
        return {
            "episodes": len(self),
            "episodes_per_env": self.per_env,
            "success_means": "goal reached" if self.has_goal else "time limit reached",
            "rates": {name: rate(happened) for name, happened in rates.items()},
            "rates_to_first_contact": {
                name: rate(happened) for name, happened in {**to_first_contact, "collision": self.collided}.items()
            },
            "time_to_goal_s": quantiles(self.length_s[reached]) if self.has_goal else None,
            "clearance_m": quantiles(self.clearance),
            "mean_length_s": float(self.length_s.mean()),
            "contacts_per_minute": 60.0 * float(self.contacts.sum() / self.length_s.sum()),
            "velocity_error_m_s": _weighted(self.velocity_error, self.length_s),
            "free_velocity_error_m_s": _weighted(self.free_velocity_error, self.free_s),
            "yaw_rate_error_rad_s": _weighted(self.yaw_rate_error, self.length_s),
            "energy_j": quantiles(self.energy),
            "power_w": float(self.energy.sum() / self.length_s.sum()),
            "cost_of_transport": float(self.energy.sum() / (self.weight * self.path.sum())),
            "us_per_env_step": dict(self.us_per_env_step),
        }


VERDICTS = ("success", "success, touched", "time out", "fall", "collision end", "diverged")
"""Verdicts on an episode, in words."""


def run_episodes(
    env: OmniEnv,
    policy: Policy,
    num_episodes: int,
    on_step: Callable[[], None] | None = None,
    keep_tracks: bool = False,
) -> Episodes:
    """Runs the first ceil(num_episodes / num_envs) episodes of every environment.

    Taking equally many episodes from each environment keeps short ones from being over-represented, as they
    would be among the first to finish.

    Args:
        env: freshly built: every environment at the start of an episode.
        policy: from observations to actions.
        num_episodes: at least so many episodes are run.
        on_step: called after every control step, in which environments that ended have already been reset.
        keep_tracks: whether to keep the robots' ways.
    """
    if num_episodes < 1:
        raise ValueError(f"episodes={num_episodes} must be at least 1")
    if bool(env.episode_length_buf.any()):
        raise ValueError("run_episodes needs a freshly built environment; this one has already been stepped")
    per_env = math.ceil(num_episodes / env.num_envs)
    tally, clock = _Tally(env, per_env), _StageClock(env)
    tracks = TrackRecorder(env, per_env) if keep_tracks else None
    hooks = [tally.record] + ([tracks.record] if tracks is not None else [])
    env.step_hooks.extend(hooks)
    try:
        with torch.no_grad():
            observations = env.get_observations()
            while not tally.complete:
                with env.timer.stage("policy"):
                    actions = policy(observations)
                observations, _, _, extras = env.step(actions)
                clock.record(extras)
                if on_step is not None:
                    on_step()
    finally:
        for hook in hooks:
            env.step_hooks.remove(hook)
    return tally.episodes(clock.us_per_env_step(), tracks.tracks() if tracks is not None else None)


class _Tally:
    """Adds up the running episode of every environment and files it when it ends."""

    def __init__(self, env: OmniEnv, per_env: int) -> None:
        self._env, self._per_env = env, per_env
        shape, device, double = (env.num_envs,), env.device, torch.float64
        self._index = torch.zeros(shape, dtype=torch.int64, device=device)
        self._sums = torch.zeros(*shape, len(_SUMS), dtype=double, device=device)
        self._filed = torch.zeros(*shape, per_env, len(_SUMS), dtype=double, device=device)
        self._outcome = torch.zeros(*shape, per_env, dtype=torch.int64, device=device)
        self._first_contact = torch.full(shape, math.inf, dtype=double, device=device)
        self._filed_contact = torch.zeros(*shape, per_env, dtype=double, device=device)
        self._clearance = Clearance(env) if env.config.obstacles.num_obstacles else None
        self._least = torch.full(shape, CLEARANCE_CAP, device=env.device)
        self._filed_least = torch.zeros(*shape, per_env, device=env.device)
        _ = env.state.joint_torque  # recorded from now on
        self._was_touching = torch.zeros(shape, dtype=torch.bool, device=env.device)
        self._knows_free = True

    @property
    def complete(self) -> bool:
        return bool((self._index >= self._per_env).all())

    def record(self) -> None:
        """Takes in the control step that has just been done, before finished environments are reset."""
        with self._env.timer.stage("measuring"):
            self._add_step()
            self._file_ended()

    def _add_step(self) -> None:
        env, dt = self._env, self._env.control_dt
        free = env.no_obstacle_near
        self._knows_free = free is not None
        if free is None:
            free = torch.zeros_like(env.done)
        began = env.contacts & ~self._was_touching
        kinematics = env.state.kinematics
        step = {
            "steps": torch.ones_like(free),
            "velocity_error": env.velocity_error,
            "yaw_rate_error": env.yaw_rate_error,
            "free": free,
            "free_velocity_error": env.velocity_error * free,
            "contacts": began,
            "energy": (env.state.joint_torque * kinematics.joint_vel).abs().sum(1) * dt,
            "path": kinematics.base_lin_vel_yaw.norm(dim=1) * dt,
        }
        healthy = ~env.sim.failed
        self._sums += torch.stack([torch.where(healthy, step[name].double(), 0.0) for name in _SUMS], 1)
        time = self._sums[:, 0] * dt
        self._first_contact = torch.where(began, torch.minimum(self._first_contact, time), self._first_contact)
        if self._clearance is not None:
            known = env.contacts | (self._index >= self._per_env)
            self._least = self._clearance.measure(self._least.masked_fill(known, 0.0))
        self._was_touching = env.contacts & ~env.done

    def _file_ended(self) -> None:
        env = self._env
        filed = (env.done & (self._index < self._per_env)).nonzero().flatten()
        slot = self._index[filed]
        self._filed[filed, slot] = self._sums[filed]
        self._filed_contact[filed, slot] = self._first_contact[filed]
        self._filed_least[filed, slot] = self._least[filed]
        self._outcome[filed, slot] = torch.stack([env.outcomes[name] for name in OUTCOMES], 1)[filed].int().argmax(1)
        self._index += env.done
        self._sums *= ~env.done[:, None]
        self._first_contact[env.done] = math.inf
        self._least[env.done] = CLEARANCE_CAP

    def episodes(self, us_per_env_step: dict[str, float], tracks: Tracks | None) -> Episodes:
        env, dt = self._env, self._env.control_dt
        sums = dict(zip(_SUMS, self._filed.flatten(0, 1).cpu().unbind(1), strict=True))
        steps, free, contacts = sums["steps"], sums["free"], sums["contacts"].long()
        clearance = None
        if self._clearance is not None:
            clearance = self._filed_least.flatten().cpu().double()
        return Episodes(
            length_s=steps * dt,
            outcome=self._outcome.flatten().cpu(),
            contacts=contacts,
            first_contact_s=self._filed_contact.flatten().cpu(),
            clearance=clearance,
            energy=sums["energy"],
            path=sums["path"],
            velocity_error=sums["velocity_error"] / steps,
            free_velocity_error=sums["free_velocity_error"] / free if self._knows_free else None,
            free_s=free * dt if self._knows_free else None,
            yaw_rate_error=sums["yaw_rate_error"] / steps,
            has_goal=env.command.goal_w is not None,
            weight=float(env.world.model.body_subtreemass[env.world.base_body]) * _GRAVITY,
            per_env=self._per_env,
            us_per_env_step=us_per_env_step,
            tracks=tracks,
        )


_SUMS = (
    "steps",
    "velocity_error",
    "yaw_rate_error",
    "free",
    "free_velocity_error",
    "contacts",
    "energy",
    "path",
)
"""Sums over the control steps of an episode."""


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


def _weighted(mean: torch.Tensor | None, weight: torch.Tensor | None) -> float | None:
    """Mean of per-episode means, weighted by their durations; None where nothing was measured."""
    if mean is None or weight is None or not bool((weight > 0).any()):
        return None
    return float(torch.where(weight > 0, mean * weight, 0.0).sum() / weight.sum())
