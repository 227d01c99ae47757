"""The perception network interface and the ablation networks (paper, Table 'PD-RiskNet Ablation Results')."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import torch
from torch import nn

from omniperception.perception.networks.windows import WindowedGru, WindowedLinear

FEATURE_DIM = 251
"""Size of PD-RiskNet's embedding, 187 + 64 (paper, App. PD-RiskNet Architecture); the ablations match it."""
NUM_SECTORS = 36
"""Azimuth sectors of obstacle nearness that an embedding can be regressed on."""


class PerceptionNetwork(nn.Module):
    """Embeds sliding windows over a sequence of sampled LiDAR frames.

    Attributes:
        num_points: P, points per frame.
        history: H, frames per window.
        feature_dim: D, size of the embedding.
        supervised: the part of the embedding that can be regressed on each privileged target.
    """

    num_points: int
    history: int
    feature_dim: int
    supervised: Mapping[str, slice] = {"sector_target": slice(0, NUM_SECTORS)}

    def __init__(self, num_points: int, history: int, feature_dim: int = FEATURE_DIM) -> None:
        super().__init__()
        for name, value in (("num_points", num_points), ("history", history), ("feature_dim", feature_dim)):
            if value < 1:
                raise ValueError(f"{type(self).__name__}: {name} must be at least 1, got {value}")
        self.num_points = num_points
        self.history = history
        self.feature_dim = feature_dim

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """Embed every window.

        Args:
            frames: (B, F, P, 3) sampled points in the sensor frame / maximum range, oldest first, F = H - 1 +
                W.
            count: (B, W) integers in 0..H; only the newest ``count[b, w]`` frames of window w (frames
                w..w+H-1) are valid.

        Returns:
            (B, W, D) embeddings.
        """
        raise NotImplementedError

    def empty(self, frames: torch.Tensor) -> torch.Tensor:
        """(1, D) embedding of a history without a valid frame; ``frames`` gives dtype, device and points."""
        history = frames.new_zeros(1, self.history, *frames.shape[2:])
        return self(history, torch.zeros(1, 1, dtype=torch.long, device=frames.device))[0]


class FpsGru(PerceptionNetwork):
    """One GRU over farthest-point samples of the whole cloud."""

    def __init__(self, num_points: int, history: int = 10, feature_dim: int = FEATURE_DIM) -> None:
        super().__init__(num_points, history, feature_dim)
        self.gru = WindowedGru(3 * num_points, feature_dim, history)

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """See :meth:`PerceptionNetwork.forward`."""
        return self.gru(frames.flatten(2), count)


class FpsMlp(PerceptionNetwork):
    """An MLP over a window's farthest-point samples, flattened; invalid frames are zeros."""

    def __init__(
        self,
        num_points: int,
        history: int = 10,
        hidden: Sequence[int] = (256,),
        feature_dim: int = FEATURE_DIM,
    ) -> None:
        """Args: num_points: P; history: H; hidden: sizes of the hidden layers; feature_dim: D."""
        super().__init__(num_points, history, feature_dim)
        sizes = [*hidden, feature_dim]
        if min(sizes) < 1:
            raise ValueError(
                f"perception.network: hidden={list(hidden)} and feature_dim={feature_dim} must be positive"
            )
        self.first = WindowedLinear(3 * num_points, sizes[0], history)
        rest: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(sizes):
            rest += [nn.ELU(), nn.Linear(fan_in, fan_out)]
        self.rest = nn.Sequential(*rest)

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """See :meth:`PerceptionNetwork.forward`."""
        return self.rest(self.first(frames.flatten(2), count))


class DirectMlp(FpsMlp):
    """The same MLP over the raw cloud, every ray in ray order with misses as zeros."""

    def __init__(
        self,
        num_rays: int,
        history: int = 10,
        hidden: Sequence[int] = (256,),
        feature_dim: int = FEATURE_DIM,
    ) -> None:
        """Args: num_rays: rays per frame; history: H; hidden: sizes of the hidden layers; feature_dim: D."""
        super().__init__(num_rays, history, hidden, feature_dim)
