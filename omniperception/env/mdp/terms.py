"""Rewards and observations as configured: weighted terms, and groups of concatenated terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from omniperception.env.mdp.rewards import AvoidanceConfig
from omniperception.env.state import checked_term, fields_read


@dataclass(frozen=True)
class RewardTerm:
    """A weighted term; a weight of 0 means that the term, and what only it reads, does not exist in this run."""

    weight: float
    func: Callable[..., torch.Tensor]


@dataclass(frozen=True)
class RewardsConfig:
    """Weighted terms by name, summed and multiplied by the control step (s).

    Attributes:
        terms: the terms.
        avoidance: how sector distances become the avoidance velocity.
    """

    terms: Mapping[str, RewardTerm]
    avoidance: AvoidanceConfig

    def __post_init__(self) -> None:
        for name, term in self.terms.items():
            if not isinstance(term, RewardTerm | None):
                raise ValueError(
                    f"terms.{name}={dict(term)} is no term, and these rewards have none of that name; use others, or"
                    f" rewards.terms.{name}=null"
                )
        used = {name: term for name, term in self.terms.items() if term is not None and term.weight != 0}
        checked = {name: replace(t, func=checked_term(f"terms.{name}.func", t.func)) for name, t in used.items()}
        object.__setattr__(self, "terms", checked)

    def readers(self) -> dict[str, frozenset[str]]:
        """The optional fields that each term reads."""
        return {f"rewards.{name}": fields_read(term.func) for name, term in self.terms.items()}


@dataclass(frozen=True)
class ObservationGroup:
    """Terms concatenated in order, `history` control steps of them (newest last).

    Attributes:
        terms: functions of the environment that return (num_envs, width).
        history: control steps kept; after a reset the first observation fills all of them.
    """

    terms: Mapping[str, Callable[..., torch.Tensor]]
    history: int = 1

    def __post_init__(self) -> None:
        used = {name: term for name, term in self.terms.items() if term is not None}
        object.__setattr__(self, "terms", {name: checked_term(f"terms.{name}", term) for name, term in used.items()})
        if self.history < 1:
            raise ValueError(f"observations: history={self.history} must be at least 1")


@dataclass(frozen=True)
class ObservationsConfig:
    """Groups by name, and which of them the actor and the critic see."""

    groups: Mapping[str, ObservationGroup]
    actor: Sequence[str]
    critic: Sequence[str]

    def __post_init__(self) -> None:
        used = [*self.actor, *self.critic]
        missing = [name for name in used if name not in self.groups]
        if missing:
            raise ValueError(f"observations: groups {missing} are used but not defined; defined: {list(self.groups)}")
        object.__setattr__(self, "groups", {name: g for name, g in self.groups.items() if name in used})
        object.__setattr__(self, "actor", tuple(self.actor))
        object.__setattr__(self, "critic", tuple(self.critic))

    def readers(self) -> dict[str, frozenset[str]]:
        """The optional fields that each term reads."""
        terms = {f"{name}.{term}": f for name, group in self.groups.items() for term, f in group.terms.items()}
        return {f"observations.{name}": fields_read(term) for name, term in terms.items()}
