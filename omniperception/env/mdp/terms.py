"""Rewards and observations as configured: weighted terms, and groups of concatenated terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, cast

import torch

from omniperception.avoidance.velocity import AvoidanceConfig
from omniperception.common.checked import AtLeastOne, checked
from omniperception.env.state import EnvState, Marked, requirements

Term = Callable[..., torch.Tensor]
"""A function of the state, or a class: see `StatefulTerm`; or a partial of one with its parameters."""


class StatefulTerm:
    """Base of terms that keep something from step to step: built once per run with their parameters, then called with
    the state in every step.

    Tensors (num_envs, ...) among the attributes are saved with a checkpoint.
    """

    def __call__(self, state: EnvState) -> torch.Tensor:
        raise NotImplementedError

    def reset(self, env_ids: torch.Tensor) -> None:
        """Begins an episode in environments (n,)."""

    def state_dict(self) -> dict:
        return {name: value.clone() for name, value in vars(self).items() if isinstance(value, torch.Tensor)}

    def load_state_dict(self, state: dict) -> None:
        vars(self).update({name: value.clone() for name, value in state.items()})


def is_class(term: Term) -> bool:
    """Tell whether a term is a class or a partial of one."""
    return isinstance(term.func if isinstance(term, partial) else term, type)


def build_term(term: Term) -> Callable[[EnvState], torch.Tensor]:
    """The term as a function of the state alone."""
    return cast(Callable[[EnvState], torch.Tensor], term() if is_class(term) else term)


JOINTS = "joints"
"""A part of a term that has a number for each joint."""
JOINT_MAGNITUDES = "joint magnitudes"
"""Likewise, of numbers without a direction, such as strengths."""
VECTOR = (1.0, -1.0, 1.0)
"""Signs of x, y, z under the reflection that maps left to right."""
ROTATION = (-1.0, 1.0, -1.0)
"""Likewise of an axial vector, such as an angular velocity."""


def mirrors(*parts: str | Sequence[float]) -> Callable[[Marked], Marked]:
    """Declares how an observation term looks in the mirror: JOINTS, JOINT_MAGNITUDES or signs, part by part. A part
    that is the only one is repeated as often as the term is wide."""

    def mark(term: Marked) -> Marked:
        term.mirror = parts  # type: ignore[attr-defined]  # functions and classes take attributes
        return term

    return mark


def measured_as(quantity: str) -> Callable[[Marked], Marked]:
    """Declares that a robot measures what an observation term of one's own gives: an exported policy reads it, in the
    same units, from `RobotState.other[quantity]`."""

    def mark(term: Marked) -> Marked:
        term.quantity = quantity  # type: ignore[attr-defined]  # functions and classes take attributes
        return term

    return mark


@dataclass(frozen=True)
class RewardTerm:
    """A weighted term; a weight of 0 means that the term, and what only it reads, does not exist in this run."""

    weight: float
    func: Term


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
        used = {name: term for name, term in self.terms.items() if term.weight != 0}
        object.__setattr__(self, "terms", used)

    def requirements(self) -> frozenset[str]:
        """Sensors that the terms need before the world is compiled, see `requires`."""
        return frozenset().union(*(requirements(term.func) for term in self.terms.values()))


@checked("observations: ")
class ObservationGroup:
    """Terms concatenated in order, `history` control steps of them (newest last).

    Attributes:
        terms: functions of the state that return (num_envs, width).
        history: control steps kept; after a reset the first observation fills all of them.
    """

    terms: Mapping[str, Term]
    history: AtLeastOne = 1


class ActorInput(NamedTuple):
    """What an input of an actor is.

    Attributes:
        group: of observations.
        term: of the group.
        age: control steps ago.
        component: which of the term's numbers.
    """

    group: str
    term: str
    age: int
    component: int

    def __str__(self) -> str:
        return f"{self.group}.{self.term}" + (f" of {self.age} steps before" if self.age else "")


def first_difference(own: Sequence[ActorInput], other: Sequence[ActorInput]) -> str | None:
    """Where the inputs of an actor first are something else than another's, in words; None: nowhere.

    What their groups are called does not count.
    """
    mine, theirs = ([one[1:] for one in inputs] for inputs in (own, other))
    if mine == theirs:
        return None
    pairs = zip(mine, theirs, strict=False)
    number = next((k for k, (one, another) in enumerate(pairs) if one != another), min(len(own), len(other)))
    here, there = (str(one[number]) if number < len(one) else "none" for one in (own, other))
    return f"input {number} of this run's policy is {here}, of that run's {there}"


@dataclass(frozen=True)
class ObservationsConfig:
    """Groups by name, which of them actor and critic see, and which one the actor estimates from what it sees.

    Attributes:
        command_acceleration: how fast (m/s^2, rad/s^2) the command that is observed, and that tracking rewards ask
            for, follows the one given; None: at once. While a curriculum gives but a share of the randomization, it
            follows faster, by 1 / share: robots that have to learn to step at all begin with commands that jump.
    """

    groups: Mapping[str, ObservationGroup]
    actor: Sequence[str]
    critic: Sequence[str]
    estimated: str | None = None
    command_acceleration: Sequence[float] | None = None

    def __post_init__(self) -> None:
        most = self.command_acceleration
        if most is not None and (len(most) != 2 or min(most) <= 0):
            raise ValueError(
                f"observations.command_acceleration={list(most)} must be [m/s^2, rad/s^2], both positive, or null"
            )
        used = [*self.actor, *self.critic, *([self.estimated] if self.estimated else [])]
        missing = [name for name in used if name not in self.groups]
        if missing:
            raise ValueError(f"observations: groups {missing} are used but not defined; defined: {list(self.groups)}")
        object.__setattr__(self, "groups", {name: g for name, g in self.groups.items() if name in used})
        object.__setattr__(self, "actor", tuple(self.actor))
        object.__setattr__(self, "critic", tuple(self.critic))

    def requirements(self) -> frozenset[str]:
        """Sensors that the terms need before the world is compiled, see `requires`."""
        terms = (term for group in self.groups.values() for term in group.terms.values())
        return frozenset().union(*map(requirements, terms))
