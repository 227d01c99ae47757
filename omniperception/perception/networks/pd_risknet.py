"""PD-RiskNet: a proximal and a distal GRU over sampled LiDAR frames (paper, Sec. 3.3.1 and App. 'PD-RiskNet
Architecture')."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import nn

from omniperception.perception.networks.base import NUM_SECTORS, PerceptionNetwork
from omniperception.perception.networks.windows import WindowedGru

if TYPE_CHECKING:
    from omniperception.perception.networks.rings import RingPath


class PdRiskNet(PerceptionNetwork):
    """Two GRUs, one over the proximal and one over the distal points; their last states are the embedding.

    One frame's sampled, sorted and flattened points are one time step. The proximal state itself is regressed
    on the height grid (17 x 11 = 187 values in -1..1, as a GRU's state), so supervision needs no extra layer.
    Beyond the paper, the first 36 distal values can be regressed on the nearness of obstacles by sector.

    A path of size 0 does not exist (ablation): the embedding is then the other path's alone. With ``rings`` the distal
    path is a :class:`RingPath` instead of a GRU; nearness and motion of obstacles by sector are then its part of the
    embedding.
    """

    def __init__(
        self,
        num_proximal: int = 256,
        num_distal: int = 128,
        history: int = 10,
        proximal_dim: int = 187,
        distal_dim: int = 64,
        distal_encoder: int = 0,
        rings: Callable[..., RingPath] | None = None,
    ) -> None:
        """Configure both paths.

        Args:
            num_proximal: points of the proximal half, first in a frame.
            num_distal: points of the distal half, after them.
            history: H, frames per window.
            proximal_dim: size of the proximal embedding and of the height grid; 0 leaves the path out.
            distal_dim: size of the distal embedding; 0 leaves the path out.
            distal_encoder: width of an ELU layer that each distal frame passes before its GRU; 0, as in the paper,
                has none.
            rings: builds the distal path from the cells per frame and H; the last row of a frame must be the base's
                motion (``perception.base_motion``), and ``distal_dim`` and ``distal_encoder`` are not read.
        """
        _check_path("proximal", num_proximal, proximal_dim)
        path = rings(num_distal=num_distal - 1, history=history) if rings is not None else None
        if path is not None:
            distal_dim, distal_encoder = path.feature_dim, 0
        _check_path("distal", num_distal, distal_dim)
        super().__init__(num_proximal + num_distal, history, proximal_dim + distal_dim)
        self.rings = path
        self.num_proximal = num_proximal
        self.proximal_dim = proximal_dim
        self.supervised = {}
        self.proximal = self.encoder = self.distal = None
        if proximal_dim:
            self.proximal = WindowedGru(3 * num_proximal, proximal_dim, history)
            self.supervised["height_target"] = slice(0, proximal_dim)
        if path is not None:
            self.supervised["motion_target"] = slice(proximal_dim, proximal_dim + distal_dim)
        elif distal_dim:
            if distal_encoder:
                self.encoder = nn.Sequential(nn.Linear(3 * num_distal, distal_encoder), nn.ELU())
            self.distal = WindowedGru(distal_encoder or 3 * num_distal, distal_dim, history)
            self.supervised["sector_target"] = slice(proximal_dim, proximal_dim + NUM_SECTORS)

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """See :meth:`PerceptionNetwork.forward`."""
        embeddings = []
        if self.proximal is not None:
            near = frames[:, :, : self.num_proximal].flatten(2)
            embeddings.append(self.proximal(near, count))
        if self.rings is not None:
            embeddings.append(self.rings(frames[:, :, self.num_proximal : -1], frames[:, :, -1], count))
        if self.distal is not None:
            far = frames[:, :, self.num_proximal :].flatten(2)
            far = far if self.encoder is None else self.encoder(far)
            embeddings.append(self.distal(far, count))
        return torch.cat(embeddings, dim=-1)


def _check_path(name: str, num_points: int, dim: int) -> None:
    """A path has points and an embedding, or neither."""
    if dim and num_points < 1:
        raise ValueError(
            f"perception.sampler.num_{name}={num_points} must be at least 1 for PD-RiskNet's {name} path; to leave the"
            f" path out also set perception.network.{name}_dim=0"
        )
    if num_points and not dim:
        raise ValueError(
            f"perception.network.{name}_dim=0 leaves the {name} path out, but {num_points} points are sampled for it;"
            f" use a sampler without a {name} half"
        )
