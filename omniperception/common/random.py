"""Counter-based random numbers: every environment draws from a stream of its own."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import torch

_GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as int64
_MIX_1 = -4658895280553007687  # 0xBF58476D1CE4E5B9
_MIX_2 = -7723592293110705685  # 0x94D049BB133111EB
_DRAWS_PER_EPISODE = 1 << 20
MOST_SEEDS = 1 << 43
"""Seeds are 0 to one less: their streams, `_PER_SEED` apart, have numbers of 64 bits."""
_PER_SEED = 1_000_003
"""Streams of a seed until the next one's begin."""


class EnvRandom:
    """Uniform numbers that depend on (seed, environment, how often that environment has drawn) and nothing else.

    What one environment draws, or when it is reset, never changes what another sees, and the whole state is one
    counter per environment. The mixing function is SplitMix64's (Steele, Lea and Flood, OOPSLA 2014).
    """

    def __init__(self, seed: int, num_envs: int, device: torch.device | str = "cpu") -> None:
        self._seed = seed
        self._key = self._keys(torch.arange(num_envs, device=device))
        self.counter = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._branches: dict[str, Branch] = {}

    def branch(self, name: str) -> Branch:
        """Streams of their own beside these, one for each environment."""
        self._branches[name] = Branch(self, name)
        return self._branches[name]

    def start_episode(self, env_ids: torch.Tensor) -> None:
        """Moves on to the part of the stream that the next episode of environments `env_ids` (n,) draws from.

        What an environment draws in its k-th episode then depends on k, not on how much it drew before.
        """
        self.counter[env_ids] = (self.counter[env_ids] // _DRAWS_PER_EPISODE + 1) * _DRAWS_PER_EPISODE

    def seed(self, env_ids: torch.Tensor, seeds: torch.Tensor) -> None:
        """Gives environments (n,) streams that follow from their seeds (n,) int64 alone; an episode has to begin next.

        The stream of a seed is that of the first environment of as many as have this seed in common.
        """
        self._key[env_ids] = _mix((seeds + 1) * _PER_SEED)
        self.counter.index_fill_(0, env_ids, 0)

    def state_dict(self) -> dict:
        """How often each environment has drawn of which stream, here and in the branches."""
        branches = {name: branch.state_dict() for name, branch in self._branches.items()}
        return {"counter": self.counter.clone(), "key": self._key.clone(), "branches": branches}

    def load_state_dict(self, state: dict) -> None:
        self.counter.copy_(state["counter"])
        if "key" in state:  # of the processes of one training all but the first go on with streams of their own
            self._key.copy_(state["key"])
        for name, branch in self._branches.items():
            branch.load_state_dict(state["branches"][name])

    def _keys(self, numbers: torch.Tensor) -> torch.Tensor:
        """Keys (n,) int64 of the streams with these numbers (n,)."""
        return _mix(numbers + (self._seed + 1) * _PER_SEED)

    def uniform(self, env_ids: torch.Tensor, shape: Sequence[int] = ()) -> torch.Tensor:
        """Draws from [0, 1) for environments `env_ids` (n,); the others' streams stay where they are.

        Returns:
            (n, *shape) float32.
        """
        size = math.prod(shape)
        draw = torch.arange(1, size + 1, device=self.counter.device)
        drawn = self.counter[env_ids][:, None]
        state = self._key[env_ids][:, None] + (drawn + draw) * _GOLDEN
        self.counter[env_ids] = drawn[:, 0] + size
        bits = _shift(_mix(state), 40)
        return (bits.float() * 2.0**-24).reshape(-1, *shape)


class Branch(EnvRandom):
    """Streams beside others: whoever draws from them changes nothing for those who draw from the others.

    An episode's draws follow from the other stream's episode and the branch's name. Call `start_episode` after the
    other streams'.
    """

    def __init__(self, trunk: EnvRandom, name: str) -> None:
        self._trunk, self._salt, self._branches = trunk, zlib.crc32(name.encode()), {}
        self._key, self.counter = torch.empty_like(trunk._key), torch.empty_like(trunk.counter)
        self.start_episode(torch.arange(len(self._key), device=self._key.device))

    def start_episode(self, env_ids: torch.Tensor) -> None:
        """Moves on to the episode in which the other streams of environments `env_ids` (n,) are."""
        self._key[env_ids] = _mix(self._trunk._key[env_ids] + self._salt)
        self.counter[env_ids] = self._trunk.counter[env_ids] // _DRAWS_PER_EPISODE * _DRAWS_PER_EPISODE


class TrialRandom(EnvRandom):
    """Streams by trial: the k-th episode to begin, counted over all environments, draws from stream k.

    What a trial draws thus depends on its number alone, not on how many environments there are or which of them runs
    it. Episodes that begin at the same moment are counted in the order of their environments.

    Attributes:
        trial: (num_envs,) int64: the number of the trial that each environment is in; -1 before its first.
    """

    def __init__(self, seed: int, num_envs: int, device: torch.device | str = "cpu") -> None:
        super().__init__(seed, num_envs, device)
        self.trial = torch.full_like(self.counter, -1)
        self._begun = 0

    def seed(self, env_ids: torch.Tensor, seeds: torch.Tensor) -> None:
        """Raises ValueError: a trial's draws follow from its number."""
        raise ValueError("seeds of a reset would be ignored in trials, whose numbers decide what they draw; give none")

    def start_episode(self, env_ids: torch.Tensor) -> None:
        """Gives environments `env_ids` (n,) the next n trials."""
        numbers = torch.arange(self._begun, self._begun + len(env_ids), device=env_ids.device)
        self._begun += len(env_ids)
        self.trial[env_ids] = numbers
        self._key[env_ids] = self._keys(numbers)
        self.counter.index_fill_(0, env_ids, 0)


def _shift(x: torch.Tensor, bits: int) -> torch.Tensor:
    """Logical right shift of int64."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _mix(x: torch.Tensor) -> torch.Tensor:
    x = (x ^ _shift(x, 30)) * _MIX_1
    x = (x ^ _shift(x, 27)) * _MIX_2
    return x ^ _shift(x, 31)
