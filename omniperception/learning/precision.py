"""Which precision a CPU multiplies matrices faster in."""

from __future__ import annotations

import functools
import itertools
import time

import torch
from torch import nn

_SAMPLES, _SIZES = 2048, (512, 256, 128)
_REPEATS = 5
_CLEARLY = 0.8
"""Share of float32's time that bfloat16 may take to be chosen."""


@functools.cache
def bfloat16_is_faster(num_threads: int) -> bool:
    """Tell whether updates of a small network take clearly less time in bfloat16 on this CPU: measured once, in 0.1 s.

    What a CPU says of its units does not tell: with AVX-512 BF16 one took half of float32's time, another 1.6 times.

    Args:
        num_threads: of PyTorch now.
    """
    times: dict[bool, list[float]] = {True: [], False: []}
    sizes = itertools.pairwise(_SIZES)
    with torch.random.fork_rng(devices=[]):  # what a seed gives does not depend on whether this was measured
        network = nn.Sequential(*(layer for a, b in sizes for layer in (nn.Linear(a, b), nn.ELU())))
    samples = torch.full((_SAMPLES, _SIZES[0]), 0.5)
    for _ in range(1 + _REPEATS):
        for in_bfloat16 in times:
            times[in_bfloat16].append(_seconds(network, samples, in_bfloat16))
    fastest = {in_bfloat16: min(taken[1:]) for in_bfloat16, taken in times.items()}  # the first warms up
    return fastest[True] < _CLEARLY * fastest[False]


def _seconds(network: nn.Module, samples: torch.Tensor, in_bfloat16: bool) -> float:
    """Time (s) of a forward and a backward pass."""
    start = time.perf_counter()
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=in_bfloat16), torch.enable_grad():
        loss = network(samples).float().square().mean()
    loss.backward()
    network.zero_grad()
    return time.perf_counter() - start
