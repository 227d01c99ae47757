"""Launching Warp kernels on tensors that come with each call, over environments and CPU threads."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable
from functools import lru_cache
from typing import Any

import torch
import warp as wp

from omniperception.lidar.launch import SplitLaunch, default_num_threads

_WORK_PER_ENV = 16384
"""Sampling one environment's cloud is worth a thread from a handful of environments on."""

_VIEW_CACHE_SIZE = 512
_views: OrderedDict[tuple, wp.array] = OrderedDict()
_LAUNCH_CACHE_SIZE = 512
_launches: OrderedDict[tuple, tuple[SplitLaunch, list]] = OrderedDict()


def view(tensor: torch.Tensor, dtype: type) -> wp.array:
    """Warp view of a tensor's memory, without a copy and, for memory seen before, without an allocation.

    The view is described by address, shape and strides alone and owns nothing: it is valid while the caller
    holds the tensor. A vector ``dtype`` takes the tensor's last dimension, which must then be contiguous.

    Raises:
        ValueError: the tensor's numbers are of another kind or size.
    """
    key = (tensor.data_ptr(), tensor.shape, tensor.stride(), dtype, tensor.dtype, tensor.device)
    cached = _views.get(key)
    if cached is not None:
        _views.move_to_end(key)
        return cached
    wp.init()
    inner = getattr(dtype, "_shape_", ())
    outer = tensor.dim() - len(inner)
    packed = tuple(math.prod(inner[axis + 1 :]) for axis in range(len(inner)))
    if (tuple(tensor.shape[outer:]), tensor.stride()[outer:]) != (inner, packed):
        raise ValueError(
            f"a {dtype.__name__} view needs contiguous last dimensions {inner}, got shape {tuple(tensor.shape)}"
            f" with strides {tensor.stride()}; pass tensor.contiguous()"
        )
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    is_float = scalar in (wp.float16, wp.bfloat16, wp.float32, wp.float64)
    if tensor.element_size() != wp.types.type_size_in_bytes(scalar) or tensor.is_floating_point() != is_float:
        raise ValueError(f"a {dtype.__name__} view needs {scalar.__name__}, got {tensor.dtype}; convert the tensor")
    cached = wp.array(
        ptr=tensor.data_ptr(),
        dtype=dtype,
        shape=tuple(tensor.shape[:outer]),
        strides=tuple(stride * tensor.element_size() for stride in tensor.stride()[:outer]),
        device=wp.device_from_torch(tensor.device),
        copy=False,
    )
    _views[key] = cached
    while len(_views) > _VIEW_CACHE_SIZE:
        _views.popitem(last=False)
    return cached


@lru_cache(64)
def constant(values: tuple[float, ...], device: torch.device) -> torch.Tensor:
    """Numbers (n,) float32 on a device, copied there once, because each copy from the host synchronises with a GPU."""
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=torch.float32, device=device)


_threads: int | None = None


def use_threads(num_threads: int | None) -> None:
    """CPU threads of the launches that name none, from now on, as `torch.set_num_threads`; None: all cores."""
    global _threads
    _threads = num_threads


def launch_over_envs(
    kernel: wp.Kernel,
    num_envs: int,
    inputs: list,
    device: torch.device,
    inner: int = 0,
    block_dim: int = 256,
    num_threads: int | None = None,
) -> None:
    """Launch ``kernel(env_offset, *inputs)`` for all environments; on the CPU it has finished at the return.

    A launch with the memory and numbers of an earlier one is replayed, because recording it takes longer than sampling
    a few environments.

    Args:
        kernel: first argument ``env_offset: int``, to be added to its first thread index.
        num_envs: size of the first launch dimension.
        inputs: the remaining arguments: Warp arrays, structs and numbers.
        device: where the arrays live. On CUDA the launch goes to torch's current stream.
        inner: size of the second launch dimension; 0 for a one-dimensional launch.
        block_dim: CUDA threads per block.
        num_threads: CPU threads; those of `use_threads` by default.
    """
    threads = num_threads or _threads or default_num_threads()
    key = (kernel, num_envs, inner, block_dim, threads, device, *map(_identity, inputs))
    known = _launches.get(key)
    if known is None:
        shape = (inner,) if inner else ()
        launch = SplitLaunch(kernel, num_envs, shape, inputs, device, threads, _WORK_PER_ENV, block_dim)
        known = _launches[key] = launch, inputs  # which are thereby kept, so that an id is not given away again
        while len(_launches) > _LAUNCH_CACHE_SIZE:
            _launches.popitem(last=False)
    else:
        _launches.move_to_end(key)
    known[0]()


def _identity(argument: Any) -> Hashable:
    """Key of a launch's argument: arrays and structs by identity, numbers and vectors by value."""
    if isinstance(argument, int | float):
        return argument
    return tuple(argument) if wp.types.type_is_vector(type(argument)) else id(argument)
