"""The network of the published avoider: a GRU for the ground below, rings for the obstacles around."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from omniperception.perception.networks.base import PerceptionNetwork
from omniperception.perception.networks.pd_risknet import check_path
from omniperception.perception.networks.windows import WindowedGru

if TYPE_CHECKING:
    from omniperception.perception.networks.rings import RingPath


class PolarRings(PerceptionNetwork):
    """A GRU over the proximal points and a :class:`RingPath` over the distal cells, side by side in the embedding.

    The GRU's last state is regressed on the height grid, as in :class:`PdRiskNet`; the rings' part on nearness and
    motion of the nearest obstacle by sector. Not the paper's network. A frame's last row is the motion of the base
    (``perception.base_motion``).
    """

    def __init__(
        self, num_proximal: int, num_distal: int, history: int, rings: Callable[..., RingPath], proximal_dim: int = 187
    ) -> None:
        """Configure both paths.

        Args:
            num_proximal: points of the proximal half, first in a frame.
            num_distal: cells of :class:`ProximitySampler` after them, and one row for the motion of the base.
            history: H, frames per window.
            rings: builds the distal path from the cells per frame and H.
            proximal_dim: size of the proximal embedding and of the height grid; 0 leaves the path out.
        """
        check_path("proximal", num_proximal, proximal_dim)
        path = rings(num_distal=num_distal - 1, history=history)
        super().__init__(num_proximal + num_distal, history, proximal_dim + path.feature_dim)
        self.rings = path
        self.num_proximal = num_proximal
        self.supervised = {"motion_target": slice(proximal_dim, self.feature_dim)}
        self.proximal = None
        if proximal_dim:
            self.proximal = WindowedGru(3 * num_proximal, proximal_dim, history)
            self.supervised["height_target"] = slice(0, proximal_dim)

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """See :meth:`PerceptionNetwork.forward`."""
        around = self.rings(frames[:, :, self.num_proximal : -1], frames[:, :, -1], count)
        if self.proximal is None:
            return around
        below = self.proximal(frames[:, :, : self.num_proximal].flatten(2), count)
        return torch.cat((below, around), dim=-1)
