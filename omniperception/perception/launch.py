"""Launching Warp kernels over environments: one launch on CUDA, one per worker thread on the CPU.

Warp runs a CPU launch on the calling thread but releases the interpreter lock meanwhile, so splitting the
environment dimension over a few persistent threads uses all cores. Every kernel launched here takes
``env_offset`` first.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch
import warp as wp
import itertools

MIN_ENVS_PER_THREAD = 4
"""Fewer environments than this are not worth another thread."""

_VIEW_CACHE_SIZE = 64
_views: OrderedDict[tuple, wp.array] = OrderedDict()


def default_num_threads() -> int:
    """Number of CPU cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def view(tensor: torch.Tensor, dtype: type) -> wp.array:
    """Warp view of a tensor's memory, without a copy and, for memory seen before, without an allocation.

    The view is described by address, shape and strides alone and owns nothing: it is valid while the caller
    holds the tensor. A vector ``dtype`` takes the tensor's last dimension, which must then be contiguous.
    """
    key = (tensor.data_ptr(), tensor.shape, tensor.stride(), dtype, tensor.device)
    cached = _views.get(key)
    if cached is not None:
        _views.move_to_end(key)
        return cached
    wp.init()
    inner = 1 if wp.types.type_is_vector(dtype) else 0
    if inner and (tensor.stride(-1) != 1 or tensor.shape[-1] != wp.types.type_size(dtype)):
        raise ValueError(
            f"a {dtype.__name__} view needs a contiguous last dimension, got shape {tuple(tensor.shape)}"
            f" with strides {tensor.stride()}; pass tensor.contiguous()"
        )
    outer = tensor.dim() - inner
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


def launch_over_envs(
    kernel: wp.Kernel,
    num_envs: int,
    inputs: list,
    device: torch.device,
    inner: int = 0,
    block_dim: int = 256,
    num_threads: int | None = None,
) -> None:
    """Launch ``kernel(env_offset, *inputs)`` for all environments and, on the CPU, wait for it.

    Args:
        kernel: first argument ``env_offset: int``, to be added to its first thread index.
        num_envs: size of the first launch dimension.
        inputs: the remaining arguments: Warp arrays, structs and numbers.
        device: where the arrays live. On CUDA the launch goes to torch's current stream.
        inner: size of the second launch dimension; 0 for a one-dimensional launch.
        block_dim: CUDA threads per block.
        num_threads: CPU threads; all the process may use by default.
    """
    if num_envs == 0:
        return
    shape = (inner,) if inner else ()
    if device.type == "cuda":
        stream = wp.stream_from_torch(torch.cuda.current_stream(device))
        wp.launch(kernel, dim=(num_envs, *shape), inputs=[0, *inputs], stream=stream, block_dim=block_dim)
        return
    threads = min(num_threads or default_num_threads(), max(1, num_envs // MIN_ENVS_PER_THREAD))
    bounds = [num_envs * i // threads for i in range(threads + 1)]

    def launch_chunk(first: int, last: int) -> None:
        wp.launch(kernel, dim=(last - first, *shape), inputs=[first, *inputs], device="cpu")

    if threads == 1:
        launch_chunk(0, num_envs)
        return
    _load_on_cpu(kernel.module)  # compiling is not for several threads at once
    pending = [_pool(threads - 1).submit(launch_chunk, *span) for span in itertools.pairwise(bounds)]
    try:
        launch_chunk(0, bounds[1])
    finally:
        for future in pending:
            future.result()


@cache
def _pool(num_workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_workers, thread_name_prefix="warp-cpu")


@cache
def _load_on_cpu(module: wp.Module) -> None:
    wp.load_module(module, device="cpu")
