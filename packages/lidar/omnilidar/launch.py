"""Kernel launches: recorded, one on a GPU and split over environments and threads on a CPU, or on tensors of a call."""

import atexit
import contextlib
import ctypes
import itertools
import math
import os
import shutil
import sys
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
import warp as wp

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # no line per compiled kernel


def _init_without_driver() -> None:
    """Initialises Warp where there is no CUDA driver, which its native code would report on file descriptor 2."""
    with contextlib.suppress(OSError):
        ctypes.CDLL("libcuda.so.1")
        return
    with contextlib.suppress(OSError):  # of a process without standard error
        saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, 2)
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            os.close(nowhere)


def _keep_kernels() -> None:
    """Has Warp keep compiled kernels for this process and its children where its usual folder cannot be written."""
    usual = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "warp")
    usual = Path(os.environ.get("WARP_CACHE_PATH") or usual)
    with contextlib.suppress(OSError):
        usual.mkdir(parents=True, exist_ok=True)
    if not os.access(usual, os.W_OK):
        kept = tempfile.mkdtemp(prefix="warp-")
        atexit.register(shutil.rmtree, kept, ignore_errors=True)
        os.environ["WARP_CACHE_PATH"] = kept
        said = f"{usual} cannot be written, so kernels are compiled anew each time; WARP_CACHE_PATH=<folder> keeps them"
        print(said, file=sys.stderr, flush=True)


_keep_kernels()
_init_without_driver()

SAY_AFTER_S = 2.0
"""How long (s) a kernel is compiled in silence."""
_launched: set[wp.Module] = set()

CHUNKS_PER_THREAD = 4
MIN_CHUNK_WORK = 65536
"""Work that is worth another thread's waking up, in units of about half a nanosecond."""


@contextlib.contextmanager
def announce_compiling(kernel: wp.Kernel) -> Iterator[None]:
    """Says what takes so long where a kernel is compiled, which Warp does once for each form and keeps on the disk.

    Args:
        kernel: that is launched; nothing is said of one that has been launched before.
    """
    module = kernel.module
    if module in _launched or any(Path(wp.config.kernel_cache_dir or ".").glob(f"wp_{module.name}_*")):
        _launched.add(module)
        yield
        return
    name = kernel.key.rpartition("__")[2]
    line = f"compiling {name} for {SAY_AFTER_S:g} s and more, once on this machine for such a scene ..."
    said = threading.Timer(SAY_AFTER_S, print, (line,), {"file": sys.stderr, "flush": True})
    said.daemon = True
    said.start()
    try:
        yield
    finally:
        said.cancel()
    _launched.add(module)


def default_num_threads() -> int:
    """Number of CPU cores that this process may use; those that torchrun starts on one machine share them evenly."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))


@cache
def thread_pool(num_workers: int) -> ThreadPoolExecutor:
    """The pool of ``num_workers`` helper threads that all launches of that width share."""
    return ThreadPoolExecutor(num_workers, thread_name_prefix="lidar")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=thread_pool.cache_clear)  # a forked process has none of its parent's threads


def split(num_envs: int, work_per_env: int, num_threads: int) -> list[tuple[int, int]]:
    """(first environment, number of environments) of each chunk; no more chunks than the work is worth."""
    worth = max(1, num_envs * work_per_env // MIN_CHUNK_WORK)
    num_chunks = min(num_envs, worth, 1 if num_threads == 1 else num_threads * CHUNKS_PER_THREAD)
    edges = [num_envs * k // num_chunks for k in range(num_chunks + 1)]
    return [(low, high - low) for low, high in itertools.pairwise(edges)]


class SplitLaunch:
    """A kernel launch over ``(num_envs, *inner)`` recorded once and replayed by calling it.

    The launch begins with environment ``first``. The kernel's first argument must be its first environment
    (``env_offset``); ``args`` are the others. The arrays are those given here: what they hold may change, where they
    lie may not.
    """

    def __init__(
        self,
        kernel: wp.Kernel,
        num_envs: int,
        inner: Sequence[int],
        args: Sequence[Any],
        device: torch.device,
        num_threads: int,
        work_per_env: int = 1,
        block_dim: int = 256,
        first: int = 0,
    ) -> None:
        self.kernel, self.name = kernel, kernel.key.rpartition("__")[2]
        self.cuda_device = device if device.type == "cuda" else None
        threads = 1 if self.cuda_device else num_threads
        chunks = split(num_envs, work_per_env, threads) if num_envs else []
        with announce_compiling(kernel):
            self.commands = [
                wp.launch(
                    kernel,
                    dim=(count, *inner),
                    inputs=[first + low, *args],
                    device=wp_device(device),
                    record_cmd=True,
                    block_dim=block_dim,
                )
                for low, count in chunks
            ]
        self.helpers = threads - 1 if len(chunks) > 1 else 0
        self.width = min(threads, len(chunks))

    def __call__(self) -> None:
        if self.cuda_device is not None:
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.cuda_device))
            for command in self.commands:
                command.launch(stream=stream)
        elif not self.helpers:
            for command in self.commands:
                command.launch()
        else:
            self._run_in_threads(thread_pool(self.helpers))

    def _run_in_threads(self, pool: ThreadPoolExecutor) -> None:
        queue = iter(self.commands)  # next() of a list iterator is atomic: each command is run by one thread

        def drain() -> None:
            for command in queue:
                command.launch()

        helpers = [pool.submit(drain) for _ in range(self.width - 1)]
        drain()
        for helper in helpers:
            helper.result()


def wp_device(device: torch.device) -> wp.Device:
    """The Warp device of a torch device."""
    if device.type == "cuda":
        return wp.get_device(f"cuda:{device.index if device.index is not None else torch.cuda.current_device()}")
    return wp.get_device(device.type)


# ---- launches on tensors that come with each call

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
