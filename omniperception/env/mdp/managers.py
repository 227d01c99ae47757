"""Evaluates the configured terms: builds those that are classes, checks their shapes, keeps histories."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from omniperception.common.stateful import Stateful
from omniperception.env.mdp.terms import ObservationGroup, RewardTerm, StatefulTerm, build_term
from omniperception.env.state import EnvState


class RewardManager(Stateful):
    """The weighted sum of the reward terms.

    Attributes:
        weighted: (num_envs,) of each term in the last step, times its weight and the control step.
    """

    saved = ("_stateful",)

    def __init__(self, terms: Mapping[str, RewardTerm], state: EnvState) -> None:
        """Raises ValueError for a term that does not return (num_envs,)."""
        self._weights = {name: term.weight for name, term in terms.items()}
        self._terms = {name: build_term(term.func) for name, term in terms.items()}
        self._stateful = _stateful(self._terms)
        self.weighted: dict[str, torch.Tensor] = {}
        for name, term in self._terms.items():
            _check_shape(f"rewards.terms.{name}", term(state), (state.num_envs,), f"({state.num_envs},)")

    def compute(self, state: EnvState, healthy: torch.Tensor) -> torch.Tensor:
        """(num_envs,) weighted sum times the control step (s); 0 for environments that are not `healthy`."""
        total = torch.zeros(state.num_envs, device=state.device)
        for name, term in self._terms.items():
            weighted = torch.where(healthy, term(state), 0.0) * (self._weights[name] * state.control_dt)
            self.weighted[name] = weighted
            total += weighted
        return total

    def reset(self, env_ids: torch.Tensor) -> None:
        """Resets the terms with memory for environments (n,) that begin an episode."""
        for term in self._stateful.values():
            term.reset(env_ids)


class ObservationManager(Stateful):
    """One observation group: its terms in order, and their history if it has one.

    Attributes:
        slices: columns of each term within a control step's observation.
        width: numbers of a control step.
    """

    saved = ("_history", "_stateful")

    def __init__(self, name: str, group: ObservationGroup, state: EnvState) -> None:
        """Raises ValueError for a term that does not return (num_envs, width)."""
        self._terms = {term_name: build_term(term) for term_name, term in group.terms.items()}
        self._stateful = _stateful(self._terms)
        self.slices: dict[str, slice] = {}
        self.width = 0
        for term_name, term in self._terms.items():
            value, expected = term(state), f"({state.num_envs}, width)"
            shape = (state.num_envs, *value.shape[1:2])
            _check_shape(f"observations.groups.{name}.terms.{term_name}", value, shape, expected)
            self.slices[term_name] = slice(self.width, self.width + value.shape[1])
            self.width += value.shape[1]
        self._history: torch.Tensor | None = None
        if group.history > 1:
            self._history = torch.zeros(state.num_envs, group.history, self.width, device=state.device)

    def compute(self, state: EnvState, fresh: torch.Tensor) -> torch.Tensor:
        """Appends the current observation, which is all that the history of environments `fresh` (n,) holds.

        Returns:
            (num_envs, history * width).
        """
        values = [term(state) for term in self._terms.values()]
        value = torch.cat(values, 1) if len(values) > 1 else values[0].clone()
        if self._history is None:
            return value
        self._history = torch.cat((self._history[:, 1:], value[:, None]), 1)
        self._history[fresh] = value[fresh, None]
        return self._history.flatten(1)

    def peek(self, state: EnvState) -> torch.Tensor:
        """(num_envs, history * width) what `compute` would return, which leaves everything as it is."""
        before = self.state_dict()
        values = self.compute(state, torch.zeros(0, dtype=torch.int64, device=state.device))
        self.load_state_dict(before)
        return values

    def begin(self, state: EnvState, fresh: torch.Tensor, observed: torch.Tensor) -> torch.Tensor:
        """`observed` (num_envs, history * width), which `compute` returned last, with episodes that begin in some
        environments `fresh` (n,); history and memory of the others stay as they are."""
        before = self.state_dict()
        values = self.compute(state, fresh)
        self.load_state_dict(_with_rows(before, self.state_dict(), fresh))
        return observed.index_copy(0, fresh, values[fresh])

    def reset(self, env_ids: torch.Tensor) -> None:
        """Resets the terms with memory for environments (n,) that begin an episode."""
        for term in self._stateful.values():
            term.reset(env_ids)


def _check_shape(name: str, value: torch.Tensor, shape: tuple[int, ...], expected: str) -> None:
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name} is of type {type(value).__name__}, expected a tensor of shape {expected}")
    if tuple(value.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {expected}")


def _with_rows(old: Any, new: Any, env_ids: torch.Tensor) -> Any:
    """The old state, nested as `state_dict` gives it, with the new rows of environments (n,) in all its tensors."""
    if isinstance(old, dict):
        return {name: _with_rows(value, new[name], env_ids) for name, value in old.items()}
    return old.index_copy(0, env_ids, new[env_ids]) if isinstance(old, torch.Tensor) else old


def _stateful(terms: Mapping[str, Callable]) -> dict[str, StatefulTerm]:
    return {name: term for name, term in terms.items() if isinstance(term, StatefulTerm)}
