"""Rays of each cloud in sampling order: proximal hits in ray order, then distal hits by (theta ring, phi).

The one operation of the samplers with a form for each kind of device: on a CPU one thread sorts the distal hits of an
environment; on a GPU, Warp's segmented sort orders all rays at once, with which sampling takes 1.4 to 1.9 times as long
on a CPU (docs/lab/perception.md). A test holds that both give the same points.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
import warp as wp

from omnilidar.launch import view
from omniperception.perception.samplers.kernels import Work
from omniperception.perception.samplers.sorting_kernels import find_parts, key_rays, sort_each_environment

SORT_ALL_RAYS_ON = ("cuda",)
"""Kinds of devices on which all rays are sorted at once; elsewhere one thread sorts an environment's."""


def sort_rays(
    launch: Callable, lanes: int, work: Work, tensors: dict[str, torch.Tensor], num_envs: int, cloud: tuple
) -> None:
    """Writes ``work.rays`` and ``work.parts``.

    Args:
        launch: launches a kernel with further arguments over environments and a number of lanes.
        lanes: see :mod:`kernels`.
        work: of the sampler.
        tensors: the work's memory by name.
        num_envs: N.
        cloud: ranges, elevation, azimuth (N, R), the elevation that splits them and the height of a ring (rad), and
            whether distal hits are wanted (1 or 0).
    """
    if tensors["keys"].device.type in SORT_ALL_RAYS_ON:
        launch(key_rays, lanes, *cloud, lanes, work)
        sort_segments(tensors["keys"], tensors["items"], num_envs)
        launch(find_parts, 0, work)
    else:
        launch(sort_each_environment, 0, *cloud, work)


def memory_of_order(items: torch.Tensor) -> torch.Tensor:
    """Buffer of the order (N, R) that :func:`sort_rays` leaves: all rays, the first half of the sorted (2, N, R)."""
    return items[0] if items.device.type in SORT_ALL_RAYS_ON else torch.empty_like(items[0])


def sort_segments(keys: torch.Tensor, items: torch.Tensor, num_envs: int) -> None:
    """Sorts the rows of the first of two halves (2, N or more, R) by key, in one launch on PyTorch's stream."""
    num_rays, device = keys.shape[2], keys.device
    count = num_envs * num_rays
    key_halves, item_halves = (view(half.view(-1)[: 2 * count], wp.int32) for half in (keys, items))
    starts = view(_starts(num_envs, num_rays, device), wp.int32)
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    with wp.ScopedStream(stream, sync_enter=False):
        wp.utils.segmented_sort_pairs(key_halves, item_halves, count, starts)


@lru_cache(64)
def _starts(num_envs: int, length: int, device: torch.device) -> torch.Tensor:
    """Begin of each row, and the end of the last one."""
    return torch.arange(num_envs + 1, dtype=torch.int32, device=device) * length
