"""Methods timed in turn within one run, so that other work on the machine disturbs all of them alike."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
import warp as wp

BLOCK_S = 0.1
"""A method is timed over about this long at a time, s."""


@dataclass
class Timing:
    """Seconds per call of each round: wall time, and CPU time of all threads of this process together."""

    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    @property
    def median_s(self) -> float:
        return statistics.median(self.wall_s)

    @property
    def median_cpu_s(self) -> float:
        return statistics.median(self.cpu_s)

    def per(self, count: int) -> Timing:
        """Of one of `count` things that a call does."""
        return Timing([s / count for s in self.wall_s], [s / count for s in self.cpu_s])

    @property
    def least_cpu_s(self) -> float:
        """Of the quickest round: other work on the machine only adds to it."""
        return min(self.cpu_s)


@dataclass(frozen=True)
class Ratio:
    """Median, smallest and largest of the rounds' ratios."""

    median: float
    smallest: float
    largest: float

    def __str__(self) -> str:
        return f"{self.median:.2f} ({self.smallest:.2f} to {self.largest:.2f})"


def paired_timings(
    calls: Mapping[str, Callable[[int], object]],
    rounds: int,
    device: str = "cpu",
    block_s: float = BLOCK_S,
    calls_per_block: int | None = None,
) -> dict[str, Timing]:
    """Times every method once per round, each round starting with another one.

    Args:
        calls: what is timed, called with the number of the call: 0, 1, ...
        rounds: how often each is timed.
        device: where they run; a GPU's work is waited for.
        block_s: about how long a method is timed at once, s.
        calls_per_block: calls that are timed at once, instead of as many as fill ``block_s``.
    """
    synchronise = device_barrier(device)
    sizes = {}
    for name, call in calls.items():
        _seconds(call, calls_per_block or 1, synchronise)  # compiles and warms up
        if calls_per_block is None:
            seconds, _ = _seconds(call, 1, synchronise)
        sizes[name] = calls_per_block or min(1000, max(1, math.ceil(block_s / seconds)))
    timings, names = {name: Timing() for name in calls}, list(calls)
    for k in range(rounds):
        for name in names[k % len(names) :] + names[: k % len(names)]:
            wall, cpu = _seconds(calls[name], sizes[name], synchronise)
            timings[name].wall_s.append(wall)
            timings[name].cpu_s.append(cpu)
    return timings


def paired_ratio(others: Timing, ours: Timing, clock: str = "wall") -> Ratio:
    """Times of another method over ours, round by round; `clock` is "wall" or "cpu"."""
    pairs = zip(getattr(others, f"{clock}_s"), getattr(ours, f"{clock}_s"), strict=True)
    ratios = [other / own for other, own in pairs]
    return Ratio(statistics.median(ratios), min(ratios), max(ratios))


def device_barrier(device: str) -> Callable[[], None]:
    """Returns a function that synchronises the host with a device; on a CPU it does nothing."""
    if not device.startswith("cuda"):
        return lambda: None

    def synchronise() -> None:
        torch.cuda.synchronize(device)
        wp.synchronize_device(device)

    return synchronise


def _seconds(call: Callable[[int], object], count: int, synchronise: Callable[[], None]) -> tuple[float, float]:
    synchronise()
    cpu, wall = time.process_time(), time.perf_counter()
    for number in range(count):
        call(number)
    synchronise()
    return (time.perf_counter() - wall) / count, (time.process_time() - cpu) / count
