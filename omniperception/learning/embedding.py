"""The embeddings that a policy acts on: computed once per LiDAR frame."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict

from omniperception.perception import PerceptionNetwork


class RolloutEmbedding:
    """Embeddings of the current LiDAR histories of one set of environments.

    Without gradients they are computed at a new tick or after a change of the parameters only. Which environments have
    been reset is told by their count of frames, so nobody has to report resets.

    Attributes:
        tick: number of the newest frame that is embedded; None before the first call.
    """

    def __init__(
        self, network: PerceptionNetwork, extend: Callable[[torch.Tensor], torch.Tensor] | None = None
    ) -> None:
        """Args: network; extend: makes what is acted on, once per embedding, from embeddings (N, D)."""
        self._network, self._extend = network, extend
        self._acted_on: torch.Tensor | None = None
        self._empty: torch.Tensor | None = None
        self.tick: int | None = None
        self._made_with: tuple | None = None
        self._seen: tuple[torch.Tensor, torch.Tensor] | None = None

    def __call__(self, obs: TensorDict) -> torch.Tensor:
        """(N, D) embeddings of the histories in the observations, extended; the empty one without a frame since the
        reset."""
        frames, count = obs["frames"], obs["frame_count"]
        with torch.no_grad():
            self._follow(obs)
        if torch.is_grad_enabled():
            features, empty = self._network(frames, count)[:, 0], self._network.empty(frames)
            if self._extend is not None:
                features, empty = self._extend(features), self._extend(empty)
        else:
            features, empty = self._acted_on, self._empty
        return torch.where(count > 0, features, empty)

    def _follow(self, obs: TensorDict) -> None:
        """Brings the embeddings up to the observations."""
        frames, count = obs["frames"], obs["frame_count"]
        probe = frames[:, -1, :2].sum((-2, -1), dtype=torch.float64)  # tells one set of environments from another
        tick, changed = self._tick_and_change(obs["frame_tick"], probe, count.squeeze(-1))
        made_with = (
            tuple(frames.shape),
            frames.device,
            torch.is_inference_mode_enabled(),
            tuple((id(p), p._version) for p in self._network.parameters()),
        )
        if tick == self.tick and not changed and made_with == self._made_with:
            return
        self._acted_on, self._empty = self._network(frames, count)[:, 0], self._network.empty(frames)
        if self._extend is not None:
            self._acted_on, self._empty = self._extend(self._acted_on), self._extend(self._empty)
        self.tick, self._made_with, self._seen = tick, made_with, (probe, count.squeeze(-1).clone())

    def _tick_and_change(self, ticks: torch.Tensor, probe: torch.Tensor, count: torch.Tensor) -> tuple[int, bool]:
        """The newest tick, and whether an environment that has a frame has another one than before.

        A reset takes frames away and adds none, so that the others' embeddings stay; one read-back for both.
        """
        if self._seen is None or len(self._seen[0]) != len(probe):
            return int(ticks.flatten()[0]), True
        before, count_before = self._seen
        other = (count > 0) & ((probe != before) | (count != count_before))
        tick, changed = torch.stack([ticks.flatten()[0], other.any().to(ticks.dtype)]).tolist()
        return tick, bool(changed)
