"""Perception networks of one's own."""

from __future__ import annotations

import torch
from torch import nn

from omniperception.perception import PerceptionNetwork


class MaxPool(PerceptionNetwork):
    """Largest features of any point (PointNet), then of any frame of the history."""

    def __init__(self, num_points: int, history: int = 10, feature_dim: int = 64) -> None:
        super().__init__(num_points, history, feature_dim)
        self.point = nn.Sequential(nn.Linear(3, feature_dim), nn.ELU(), nn.Linear(feature_dim, feature_dim))

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        """Frames (B, F, P, 3), of each window's (B, W) the newest valid -> (B, W, D)."""
        by_frame = self.point(frames).amax(2)  # (B, F, D), once however many windows share a frame
        windows = by_frame.unfold(1, self.history, 1)  # (B, W, D, H), oldest first
        age = torch.arange(self.history - 1, -1, -1, device=frames.device)
        invalid = age >= count[..., None]  # (B, W, H)
        pooled = windows.masked_fill(invalid[:, :, None], float("-inf")).amax(-1)
        return torch.where((count > 0)[..., None], pooled, torch.zeros_like(pooled))
