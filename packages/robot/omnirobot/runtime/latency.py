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


@dataclass(frozen=True)
class Latency:
    """Milliseconds of each timed control step.

    Attributes:
        with_frame: (n,) of the steps in which a frame was sampled.
        without_frame: (m,) of the others.
    """

    with_frame: np.ndarray
    without_frame: np.ndarray

    def summary(self) -> dict[str, dict[str, float]]:
        """Number of steps, percentiles and maximum of each kind of step that occurs."""
        kinds = {"with_frame": self.with_frame, "without_frame": self.without_frame}
        return {name: _percentiles(times) for name, times in kinds.items() if len(times)}


def measure(policy: ExportedPolicy, readings: Sequence[Reading], steps: int) -> Latency:
    """Times `steps` control steps through the readings again and again, after a pass that is not timed."""
    policy.reset()
    for reading in readings:
        policy.step(reading.state, reading.command, reading.points)
    times: dict[bool, list[float]] = {True: [], False: []}
    for k in range(steps):
        reading = readings[k % len(readings)]
        start = time.perf_counter()
        policy.step(reading.state, reading.command, reading.points)
        times[reading.points is not None].append(1e3 * (time.perf_counter() - start))
    return Latency(np.array(times[True]), np.array(times[False]))


def _percentiles(times: np.ndarray) -> dict[str, float]:
    times_ms = {f"p{p}_ms": float(np.percentile(times, p)) for p in PERCENTILES}
    return {"steps": len(times), **times_ms, "max_ms": float(times.max())}
