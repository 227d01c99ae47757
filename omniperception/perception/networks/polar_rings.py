"""The network of the published avoider: rings for the obstacles around."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from omniperception.perception.networks.base import PerceptionNetwork

if TYPE_CHECKING:
    from omniperception.perception.networks.rings import RingPath


class PolarRings(PerceptionNetwork):
    """A :class:`RingPath` over the cells of :class:`StandingSampler`.

    Its embedding is regressed on nearness and motion of the nearest obstacle by sector. Not the paper's network. A
    frame's last row is the motion of the base (``perception.base_motion``).
    """

    def __init__(self, num_cells: int, history: int, rings: Callable[..., RingPath], times: bool = False) -> None:
        """Configure the path.

        Args:
            num_cells: cells of the sampler, and one row for the motion of the base, or three with `times`.
            history: H, frames per window.
            rings: builds the path from the cells per frame and H.
            times: whether frames say when they were taken (``perception.frame_times``).
        """
        self._rows = 3 if times else 1
        more = {"times": True} if times else {}
        path = rings(num_cells=num_cells - self._rows, history=history, **more)
        super().__init__(num_cells, history, path.feature_dim)
        self.rings = path
        self.supervised = {"motion_target": slice(0, path.motion_dim)}
        if path.risk is not None:
            self.supervised["risk"] = slice(path.motion_dim, path.feature_dim)

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """See :meth:`PerceptionNetwork.forward`."""
        cells, rows = frames[:, :, : -self._rows], frames[:, :, -self._rows :].unbind(2)
        return self.rings(cells, rows[0], count, *rows[1:])
