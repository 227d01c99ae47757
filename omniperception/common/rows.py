"""Rows of some environments: by index where counting them costs nothing, by mask where it would wait for a GPU.

What is done to "some environments" takes `envs`, which is either

- (n,) int64, their indices: values for them have n rows; or
- (num_envs,) bool, a mask: values have a row for every environment, and those of the others are thrown away.

Every environment has a random stream of its own, so both give the same results. Indices do no more than is needed, but
how many there are has to be known before the next kernel can be launched.
"""

from __future__ import annotations

import torch

COUNTED_FREE_ON = ("cpu",)
"""Kinds of devices on which the host knows at once how many environments a mask holds."""


def chosen(mask: torch.Tensor, costly: bool = False) -> torch.Tensor:
    """`envs` of a mask (num_envs,) bool: indices on a CPU, the mask itself on a GPU.

    Where a row is so `costly` that the rows of all would take longer than waiting, a GPU's are indices, too.
    """
    return mask.nonzero().flatten() if costly or mask.device.type in COUNTED_FREE_ON else mask


def take(values: torch.Tensor, envs: torch.Tensor) -> torch.Tensor:
    """The rows of `values` (num_envs, ...) that go with `envs`; all of them for a mask."""
    return values if envs.dtype == torch.bool else values[envs]


def put(target: torch.Tensor, envs: torch.Tensor, values: torch.Tensor | float) -> None:
    """Writes `values`, a number or rows that go with `envs`, into `target` (num_envs, ...) in place."""
    if isinstance(values, torch.Tensor):
        values = values.to(target.dtype)
    if envs.dtype != torch.bool:
        target[envs] = values
    elif isinstance(values, torch.Tensor):
        target.copy_(torch.where(_column(envs, target), values, target))
    else:
        target.masked_fill_(_column(envs, target), values)


def replaced(values: torch.Tensor, envs: torch.Tensor, new: torch.Tensor | float) -> torch.Tensor:
    """A copy of `values` (num_envs, ...) with `new`, a number or rows that go with `envs`, in the rows of `envs`."""
    copy = values.clone()
    put(copy, envs, new)
    return copy


def _column(mask: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """The mask with as many dimensions as `values`."""
    return mask.reshape(-1, *(1,) * (values.dim() - 1))
