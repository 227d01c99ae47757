"""Rows of some environments by their indices; what is left of it until its callers index themselves."""

from __future__ import annotations

import torch


def chosen(mask: torch.Tensor, costly: bool = False) -> torch.Tensor:
    """Indices of a mask."""
    return mask.nonzero().flatten()


def take(values: torch.Tensor, envs: torch.Tensor) -> torch.Tensor:
    """The rows of `values` (num_envs, ...) of `envs`."""
    return values[envs]


def put(target: torch.Tensor, envs: torch.Tensor, values: torch.Tensor | float) -> None:
    """Writes `values`, a number or rows, into `target` (num_envs, ...) in place."""
    target[envs] = values.to(target.dtype) if isinstance(values, torch.Tensor) else values


def replaced(values: torch.Tensor, envs: torch.Tensor, new: torch.Tensor | float) -> torch.Tensor:
    """A copy of `values` (num_envs, ...) with `new` in the rows of `envs`."""
    copy = values.clone()
    put(copy, envs, new)
    return copy
