"""Azimuth sectors: in which one a place lies, and sums over what lies in each."""

from __future__ import annotations

import math

import torch

FAR = 1e3
"""Distance (m) of no obstacle where a computation needs a finite number; elsewhere it is infinite."""


def bearing_in_sectors(places: torch.Tensor, num_sectors: int) -> torch.Tensor:
    """(...) azimuth from -pi on of places (..., 2), in widths of a sector."""
    return (torch.atan2(places[..., 1], places[..., 0]) + math.pi) * (num_sectors / (2.0 * math.pi))


def sector_at(bearing: torch.Tensor, num_sectors: int) -> torch.Tensor:
    """(...) int64 sector of bearings (...) in widths of a sector."""
    return bearing.long().clamp(0, num_sectors - 1)


def sector_of(places: torch.Tensor, num_sectors: int) -> torch.Tensor:
    """(...) int64 azimuth sector of places (..., 2); sector 0 starts at -pi."""
    return sector_at(bearing_in_sectors(places, num_sectors), num_sectors)


def sums_by(index: torch.Tensor, values: torch.Tensor, num: int) -> torch.Tensor:
    """(n, num) sums of values (n, k) by index (n, k)."""
    return values.new_zeros(len(values), num).scatter_add_(1, index, values)
