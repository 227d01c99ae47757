"""Outcomes of trials, and the figures that follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.trials.statistics import quantiles, rate
from omniperception.evaluation.trials.tracks import Tracks

CLEARANCE_CAP = 1.0
"""Clearances (m) beyond this are reported as this."""
GRAVITY = 9.81

_COLUMNS = (
    *("length_s", "outcome", "contacts", "first_contact_s", "impulse", "clearance", "energy", "path", "free_time_s"),
    *("velocity_error", "free_velocity_error", "free_s", "yaw_rate_error", "world"),
)
"""Fields of `Episodes` with a number for each trial."""
_WHOLE = ("outcome", "contacts", "world")
_DIGITS = 5


@dataclass(frozen=True)
class Episodes:
    """Outcomes of trials; tensors are (num_trials,), in the order of the trials' numbers, float64 unless said.

    Attributes:
        length_s: duration (s).
        outcome: int64 index into `omniperception.env.metrics.OUTCOMES`: how it ended.
        contacts: int64 number of times that the robot began to touch obstacles.
        first_contact_s: time (s) of the first touch, infinite without one.
        impulse: of the contacts with obstacles (N s): sum over obstacles and physics steps of |force| * step; None
            where it was not measured.
        clearance: smallest distance (m) in space between any link and any obstacle, at the end of every
            CLEARANCE_EVERY-th control step; 0 in a trial with a touch, CLEARANCE_CAP where nothing came nearer; None
            without obstacles.
        energy: sum over joints and control steps of |torque * joint velocity| * dt (J), the torque of the last physics
            step of each control step.
        path: length (m) of the base's horizontal way.
        free_time_s: time (s) that the straight way to the goal takes at the commanded speed, in a maze the
            route through the middles of its cells, at least until which the goal has to be held; None without goals.
        velocity_error: mean error of the horizontal velocity (m/s) against the task's command.
        free_velocity_error: the same over the moments with no obstacle near, NaN in a trial without such a moment; None
            where the run does not measure distances to obstacles.
        free_s: time with no obstacle near (s); None as above.
        yaw_rate_error: mean error of the yaw rate (rad/s).
        has_goal: whether the commands lead to a goal.
        weight: of the robot (N).
        world: int64 number of the world of the obstacles' layout, as in its table; None without a layout.
        us_per_env_step: wall time by stage in microseconds per environment and control step; `policy` is the network,
            `measuring` what is measured here.
        tracks: ways of the robots, where asked for.
        walking: figures of a gait by name, as in `walking.COLUMNS`; None where they were not measured.
    """

    length_s: torch.Tensor
    outcome: torch.Tensor
    contacts: torch.Tensor
    first_contact_s: torch.Tensor
    impulse: torch.Tensor | None
    clearance: torch.Tensor | None
    energy: torch.Tensor
    path: torch.Tensor
    free_time_s: torch.Tensor | None
    velocity_error: torch.Tensor
    free_velocity_error: torch.Tensor | None
    free_s: torch.Tensor | None
    yaw_rate_error: torch.Tensor
    has_goal: bool
    weight: float
    world: torch.Tensor | None = None
    us_per_env_step: dict[str, float] = field(default_factory=dict)
    tracks: Tracks | None = None
    walking: dict[str, torch.Tensor] | None = None

    def __len__(self) -> int:
        return len(self.length_s)

    def ended(self, name: str) -> torch.Tensor:
        """(num_trials,) bool: which trials ended for this reason, one of OUTCOMES."""
        return self.outcome == OUTCOMES.index(name)

    @property
    def collided(self) -> torch.Tensor:
        """(num_trials,) bool: at least one contact with an obstacle."""
        return self.contacts > 0

    @property
    def success(self) -> torch.Tensor:
        """(num_trials,) bool: the goal or, without one, the time limit was reached. Touches do not count."""
        return self.ended("goal" if self.has_goal else "time_out")

    @property
    def clean(self) -> torch.Tensor:
        """(num_trials,) bool: success without a touch; a fall ends a trial, so that there is none in a success."""
        return self.success & ~self.collided

    def happened(self) -> dict[str, torch.Tensor]:
        """(num_trials,) bool each: what rates are given of; the first decides."""
        rates = {"untouched": self.clean, "success": self.success, "collision": self.collided}
        ends = ("fall", "time_out", "diverged") if self.has_goal else ("fall", "diverged")
        if bool(self.ended("collision_end").any()):
            ends = (*ends, "collision_end")  # where a touch ends a trial
        return rates | {name: self.ended(name) for name in ends}

    @property
    def time_ratio(self) -> torch.Tensor | None:
        """(num_successes,) time to the goal over the free time; None without goals."""
        if self.free_time_s is None or not self.has_goal:
            return None
        return self.length_s[self.success] / self.free_time_s[self.success].clamp(min=1e-6)

    @property
    def touched_impulse(self) -> torch.Tensor | None:
        """(num_touched,) N s: impulse of the contacts in the trials with a touch; None where it was not measured.

        Obstacles do not give way: between one and a wall forces have no bound, so that means say nothing.
        """
        return None if self.impulse is None else self.impulse[self.collided]

    @property
    def touches_per_100_m(self) -> float:
        """Touches of all trials over the length of all ways."""
        return 100.0 * float(self.contacts.sum()) / max(float(self.path.sum()), 1e-6)

    def summary(self) -> dict:
        """Rates with 95 % Wilson intervals, means and quantiles, as plain numbers."""
        return {
            "trials": len(self),
            "success_means": "goal reached" if self.has_goal else "time limit reached",
            "rates": {name: rate(happened) for name, happened in self.happened().items()},
            "touches_per_100_m": self.touches_per_100_m,
            "touched_impulse_n_s": quantiles(self.touched_impulse),
            "time_over_free_time": quantiles(self.time_ratio),
            "clearance_m": quantiles(self.clearance),
            "mean_length_s": float(self.length_s.mean()),
            "velocity_error_m_s": _weighted(self.velocity_error, self.length_s),
            "free_velocity_error_m_s": _weighted(self.free_velocity_error, self.free_s),
            "yaw_rate_error_rad_s": _weighted(self.yaw_rate_error, self.length_s),
            "energy_j": quantiles(self.energy),
            "cost_of_transport": float(self.energy.sum() / (self.weight * self.path.sum())),
            "us_per_env_step": dict(self.us_per_env_step),
        }

    def columns(self) -> dict:
        """All but the tracks as plain data: columns of `_DIGITS` digits, null for what is infinite or not a number."""
        plain: dict[str, Any] = {"has_goal": self.has_goal, "weight": round(self.weight, 3)}
        values = {name: getattr(self, name) for name in _COLUMNS}
        plain |= {name: _plain(name, value) for name, value in values.items() if value is not None}
        if self.walking is not None:
            plain["walking"] = {name: _plain(name, value) for name, value in self.walking.items()}
        return plain

    @classmethod
    def from_columns(cls, plain: Mapping[str, Any], us_per_env_step: Mapping[str, float] | None = None) -> Episodes:
        """What `columns` was made of, to `_DIGITS` digits."""
        named: dict[str, Any] = {name: _tensor(name, plain[name]) if name in plain else None for name in _COLUMNS}
        walking = {n: _tensor(n, v) for n, v in plain["walking"].items()} if "walking" in plain else None
        given = {"has_goal": plain["has_goal"], "weight": plain["weight"], "walking": walking}
        return cls(**named, **given, us_per_env_step=dict(us_per_env_step or {}))


def _plain(name: str, values: torch.Tensor) -> list:
    return values.tolist() if name in _WHOLE else [_rounded(value) for value in values.tolist()]


def _rounded(value: float) -> float | None:
    number = float(f"{value:.{_DIGITS}g}")
    return number if abs(number) < float("inf") else None  # also where it is NaN


def _tensor(name: str, values: list) -> torch.Tensor:
    if name in _WHOLE:
        return torch.tensor(values, dtype=torch.int64)
    nothing = float("inf") if name == "first_contact_s" else float("nan")
    return torch.tensor([nothing if value is None else value for value in values], dtype=torch.float64)


def _weighted(mean: torch.Tensor | None, weight: torch.Tensor | None) -> float | None:
    """Mean of per-trial means, weighted by their durations; None where nothing was measured."""
    if mean is None or weight is None or not bool((weight > 0).any()):
        return None
    return float(torch.where(weight > 0, mean * weight, 0.0).sum() / weight.sum())
