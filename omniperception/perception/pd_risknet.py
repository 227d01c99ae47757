"""PD-RiskNet: a proximal and a distal GRU over sampled LiDAR frames (paper, Sec. 3.3.1 and App.
architecture)."""

from __future__ import annotations

import torch
from torch import nn

from omniperception.perception.networks import NUM_SECTORS, PerceptionNetwork
from omniperception.perception.windows import WindowedGru


class PdRiskNet(PerceptionNetwork):
    """Two GRUs, one over the proximal and one over the distal points; their last states are the embedding.

    One frame's sampled, sorted and flattened points are one time step. The proximal state itself is regressed
    on the height grid (17 x 11 = 187 values in -1..1, as a GRU's state), so supervision needs no extra layer.
    Beyond the paper, the first 36 distal values can be regressed on the nearness of obstacles by sector.
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
            proximal_dim: size of the proximal embedding and of the height grid.
            distal_dim: size of the distal embedding.
            distal_encoder: width of an ELU layer that each distal frame passes before its GRU; 0, as in the paper,
                has none.
        """
        for name, value in (("num_proximal", num_proximal), ("num_distal", num_distal)):
            if value < 1:
                raise ValueError(f"perception.sampler.{name}={value} must be at least 1 for PD-RiskNet")
        super().__init__(num_proximal + num_distal, history, proximal_dim + distal_dim)
        self.num_proximal = num_proximal
        self.proximal_dim = proximal_dim
        self.proximal = WindowedGru(3 * num_proximal, proximal_dim, history)
        self.encoder = nn.Sequential(nn.Linear(3 * num_distal, distal_encoder), nn.ELU()) if distal_encoder else None
        self.distal = WindowedGru(distal_encoder or 3 * num_distal, distal_dim, history)
        self.supervised = {
            "height_target": slice(0, proximal_dim),
            "sector_target": slice(proximal_dim, proximal_dim + NUM_SECTORS),
        }

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """See :meth:`PerceptionNetwork.forward`."""
        near = self.proximal(frames[:, :, : self.num_proximal].flatten(2), count)
        far = frames[:, :, self.num_proximal :].flatten(2)
        far = self.distal(far if self.encoder is None else self.encoder(far), count)
        return torch.cat([near, far], dim=-1)
