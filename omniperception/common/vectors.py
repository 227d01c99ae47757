"""Vectors on tensors, batch first."""

from __future__ import annotations

import torch


def moved_towards(now: torch.Tensor, there: torch.Tensor, most: float) -> torch.Tensor:
    """Vectors (n, D) `now`, moved towards `there` by a length of at most `most` > 0."""
    change = there - now
    return now + change * (most / change.norm(dim=1, keepdim=True).clamp(min=most))
