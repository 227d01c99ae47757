"""Latency of an exported policy from sensor readings to joint targets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnirobot.runtime.runtime import ExportedPolicy, RobotState

PERCENTILES = (50, 95, 99)


@dataclass(frozen=True)
class Reading:
    """Input of a control step: state, command (3,), and a frame (n, 3) in m, or None."""

    state: RobotState
    command: np.ndarray
    points: np.ndarray | None


def measure(policy: ExportedPolicy, readings: Sequence[Reading], steps: int) -> dict[str, dict[str, float]]:
    """Times `steps` control steps through the readings again and again, after a pass that is not timed.

    Returns:
        Number of steps, percentiles and maximum (ms) of those in which a frame was sampled, and of the others.
    """
    policy.reset()
    for reading in readings:
        policy.step(reading.state, reading.command, reading.points)
    times: dict[str, list[float]] = {"with frame": [], "without frame": []}
    for k in range(steps):
        reading = readings[k % len(readings)]
        start = time.perf_counter()
        policy.step(reading.state, reading.command, reading.points)
        kind = "without frame" if reading.points is None else "with frame"
        times[kind].append(1e3 * (time.perf_counter() - start))
    return {kind: _percentiles(np.array(each)) for kind, each in times.items() if each}


def _percentiles(times: np.ndarray) -> dict[str, float]:
    times_ms = {f"p{p}_ms": float(np.percentile(times, p)) for p in PERCENTILES}
    return {"steps": len(times), **times_ms, "max_ms": float(times.max())}
