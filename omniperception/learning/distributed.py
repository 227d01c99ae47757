"""Several processes that learn one policy, each in environments of its own, as torchrun starts them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TypeVar

import torch
import torch.distributed as dist

Value = TypeVar("Value")

SEED_STRIDE = 100_003
"""Seeds of two ranks are this far apart."""


def rank() -> int:
    """Number of this process among all, 0 where it is alone."""
    return int(os.environ.get("RANK", 0)) if world_size() > 1 else 0


def world_size() -> int:
    """Number of processes."""
    return int(os.environ.get("WORLD_SIZE", 1))


def multi_gpu() -> dict[str, int] | None:
    """rsl_rl's `multi_gpu_cfg`, for processes on CPUs as well; None for a single process."""
    return {"global_rank": rank(), "world_size": world_size()} if world_size() > 1 else None


def connect(device: torch.device | str) -> None:
    """Joins the other processes, once: by NCCL from a GPU, by gloo from a CPU."""
    if world_size() == 1 or dist.is_initialized():
        return
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if on_gpu else "gloo", rank=rank(), world_size=world_size())


def disconnect() -> None:
    """Leaves the process group, as every process must before it ends."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def of_first(value: Value) -> Value:
    """The first process's value, in all of them."""
    if world_size() == 1:
        return value
    shared = [value]
    dist.broadcast_object_list(shared, src=0)
    return shared[0]


def mean(value: float, device: torch.device | str) -> float:
    """Mean over all processes, the same bits in each."""
    if world_size() == 1:
        return value
    total = torch.tensor(value, dtype=torch.float64, device=device)
    dist.all_reduce(total)
    return total.item() / world_size()


def average_gradients(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Replaces gradients by their mean over all processes; those that one has, all must have."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    if world_size() == 1 or not gradients:
        return
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    flat /= world_size()
    for gradient, mean_ in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(mean_.view_as(gradient))
