"""PD-RiskNet: a proximal and a distal GRU over sampled LiDAR frames (paper, Sec. 3.3.1 and App. 'PD-RiskNet
Architecture'); and the same two GRUs over proximities."""

from __future__ import annotations

import torch
from torch import nn

from omniperception.perception.networks.base import NUM_SECTORS, PerceptionNetwork
from omniperception.perception.networks.windows import WindowedGru


class PdRiskNet(PerceptionNetwork):
    """Two GRUs, one over the proximal and one over the distal points; their last states are the embedding.

    One frame's sampled, sorted and flattened points are one time step. The proximal state itself is regressed
    on the height grid (17 x 11 = 187 values in -1..1, as a GRU's state), so supervision needs no extra layer.
    Beyond the paper, the first 36 distal values can be regressed on the nearness of obstacles by sector.

    A path of size 0 does not exist (ablation): the embedding is then the other path's alone.
    """

    def __init__(
        self,
        num_proximal: int = 256,
        num_distal: int = 128,
        history: int = 10,
        proximal_dim: int = 187,
        distal_dim: int = 64,
        distal_encoder: int = 0,
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
        """
        check_path("proximal", num_proximal, proximal_dim)
        check_path("distal", num_distal, distal_dim)
        for name, size in (
            ("proximal_dim", proximal_dim),
            ("distal_dim", distal_dim),
            ("distal_encoder", distal_encoder),
        ):
            if size < 0:
                raise ValueError(f"perception.network.{name}={size} must not be negative; 0 leaves it out")
        super().__init__(num_proximal + num_distal, history, proximal_dim + distal_dim)
        self.num_proximal = num_proximal
        self.supervised = {}
        self.proximal = self.encoder = self.distal = None
        if proximal_dim:
            self.proximal = WindowedGru(3 * num_proximal, proximal_dim, history)
            self.supervised["height_target"] = slice(0, proximal_dim)
        if distal_dim:
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
        if self.distal is not None:
            far = frames[:, :, self.num_proximal :].flatten(2)
            far = far if self.encoder is None else self.encoder(far)
            embeddings.append(self.distal(far, count))
        return torch.cat(embeddings, dim=-1)


class ProximityGru(PdRiskNet):
    """PD-RiskNet's two GRUs where the distal half is a grid of proximities (:class:`ProximitySampler`), not points.

    Each distal frame passes a layer before its GRU. It is not the paper's network, and is meant for other supervision:
    obstacle nearness by sector and the avoidance velocity (conf/perception/proximity_gru.yaml).
    """

    def __init__(
        self,
        num_proximal: int,
        num_distal: int,
        history: int,
        proximal_dim: int = 187,
        distal_dim: int = 64,
        distal_encoder: int = 128,
    ) -> None:
        """See :class:`PdRiskNet`; num_distal: cells of the grid."""
        super().__init__(num_proximal, num_distal, history, proximal_dim, distal_dim, distal_encoder)


def check_path(name: str, num_points: int, dim: int) -> None:
    """A path has points and an embedding, or neither."""
    if dim and num_points < 1:
        raise ValueError(
            f"perception.sampler.num_{name}={num_points} must be at least 1 for the {name} path; to leave it out"
            f" also set perception.network.{name}_dim=0"
        )
    if num_points and not dim:
        raise ValueError(
            f"perception.network.{name}_dim=0 leaves the {name} path out, but {num_points} points are sampled for it;"
            f" use a sampler without a {name} half"
        )
