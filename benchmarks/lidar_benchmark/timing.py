"""Methods timed in turn within one run, so that what else the machine does meets all of them alike."""

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
    """Seconds per frame of each round, on the clock and of all this process's threads together."""

    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    @property
    def median_s(self) -> float:
        return statistics.median(self.wall_s)

    @property
    def median_cpu_s(self) -> float:
        return statistics.median(self.cpu_s)


@dataclass(frozen=True)
class Ratio:
    """Median, smallest and largest of the rounds' ratios."""

    median: float
    smallest: float
    largest: float


def paired_timings(
    casts: Mapping[str, Callable[[int], None]], rounds: int, device: str = "cpu", block_s: float = BLOCK_S
) -> dict[str, Timing]:
    """Times every method once per round, each round starting with another one.

    Args:
        casts: Callables that cast the frame of a given number.
        rounds: How often each is timed.
        device: Where they run; a GPU's work is waited for.
        block_s: About how long a method is timed at once, s.
    """
    wait = device_barrier(device)
    frames = {name: _frames_per_block(cast, block_s, wait) for name, cast in casts.items()}
    timings, names = {name: Timing() for name in casts}, list(casts)
    for k in range(rounds):
        for name in names[k % len(names) :] + names[: k % len(names)]:
            wall, cpu = _seconds(casts[name], frames[name], wait)
            timings[name].wall_s.append(wall)
            timings[name].cpu_s.append(cpu)
    return timings


def paired_ratio(others: Timing, ours: Timing) -> Ratio:
    """How many times faster ours is, round by round."""
    ratios = [other / own for other, own in zip(others.wall_s, ours.wall_s, strict=True)]
    return Ratio(statistics.median(ratios), min(ratios), max(ratios))


def device_barrier(device: str) -> Callable[[], None]:
    """Waits until a device has done everything; nothing to wait for on a CPU."""
    if not device.startswith("cuda"):
        return lambda: None

    def wait() -> None:
        torch.cuda.synchronize(device)
        wp.synchronize_device(device)

    return wait


def _frames_per_block(cast: Callable[[int], None], block_s: float, wait: Callable[[], None]) -> int:
    """Compiles and warms up, then finds how many frames fill a block."""
    _seconds(cast, 1, wait)
    seconds, _ = _seconds(cast, 1, wait)
    return min(1000, max(1, math.ceil(block_s / seconds)))


def _seconds(cast: Callable[[int], None], num_frames: int, wait: Callable[[], None]) -> tuple[float, float]:
    wait()
    cpu, wall = time.process_time(), time.perf_counter()
    for frame in range(num_frames):
        cast(frame)
    wait()
    return (time.perf_counter() - wall) / num_frames, (time.process_time() - cpu) / num_frames
