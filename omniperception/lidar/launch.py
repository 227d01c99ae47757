"""Recorded kernel launches: one on a GPU, split over environments and threads on a CPU."""

import atexit
import contextlib
import ctypes
import itertools
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
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
def compiling_is_said(kernel: wp.Kernel) -> Iterator[None]:
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
        with compiling_is_said(kernel):
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
