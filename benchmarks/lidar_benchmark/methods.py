"""What a ray-casting method owes the benchmark, and how its environments are split over threads."""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from .scenes import BenchmarkScene


class Method(Protocol):
    """One way of casting a scene's rays.

    Attributes:
        scene: What it casts; its scan may differ from the benchmark's where a method cannot take other rays.
        rotates_rays: Whether it is given rays in the sensor frame and rotates them itself; otherwise it is given
            float32 directions in the environments' frames, whose making is not counted.
    """

    scene: BenchmarkScene
    rotates_rays: bool

    def cast(self, frame: int) -> None:
        """Takes over the poses of ``frame`` and casts all rays. This is what is timed."""

    def ranges(self) -> np.ndarray:
        """What the last cast found, metres, ``inf`` for a miss, (num_envs, R)."""


Build = Callable[[BenchmarkScene, int, str], Method]
"""(scene, number of threads, device) -> method."""


class NotForThisScene(Exception):
    """A method cannot show this scene, or not on this device; the message says why."""


@dataclass(frozen=True)
class Entry:
    """A method that may be installed.

    Attributes:
        name: What reports call it.
        build: Builds it for a scene.
        modules: Modules that it needs.
        package: How to install them.
        own_threads: Whether it spreads its work over threads itself; others get a row of their own with their
            environments split over threads.
        shared_scan: Whether it takes the same rays for all environments only, those of the first.
        devices: Kinds of devices on which it runs.
    """

    name: str
    build: Build
    modules: tuple[str, ...] = ()
    package: str = ""
    own_threads: bool = False
    shared_scan: bool = False
    devices: tuple[str, ...] = ("cpu",)

    def missing(self) -> list[str]:
        """Modules that are not installed."""
        return [module for module in self.modules if importlib.util.find_spec(module) is None]


class SplitMethod:
    """A method's environments divided evenly over threads, one instance each."""

    def __init__(self, build: Build, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        edges = [scene.num_envs * k // num_threads for k in range(num_threads + 1)]
        spans = [(low, high) for low, high in itertools.pairwise(edges) if high > low]
        self.parts = [build(scene.environments(low, high), 1, device) for low, high in spans]
        self.scene = scene
        self.rotates_rays = self.parts[0].rotates_rays
        self._pool = ThreadPoolExecutor(max(1, len(self.parts) - 1), thread_name_prefix="split")

    def cast(self, frame: int) -> None:
        helpers = [self._pool.submit(part.cast, frame) for part in self.parts[1:]]
        self.parts[0].cast(frame)
        for helper in helpers:
            helper.result()

    def ranges(self) -> np.ndarray:
        return np.concatenate([part.ranges() for part in self.parts])


def finite_ranges(distances: np.ndarray, max_range: float) -> np.ndarray:
    """Distances of which negative ones and those beyond the range are misses, as float64 with ``inf``."""
    distances = np.asarray(distances, dtype=np.float64)
    return np.where((distances < 0.0) | (distances > max_range), np.inf, distances)


def build_all(
    entries: Sequence[Entry], scene: BenchmarkScene, num_threads: int, device: str
) -> tuple[dict[str, Method], dict[str, str]]:
    """The methods that run here by name, each having cast a frame, and why each of the others was left out.

    A peer that fails is named with its message rather than ending everybody's run.
    """
    methods, skipped = {}, {}
    for entry in entries:
        reason = _why_not(entry, device)
        if reason:
            skipped[entry.name] = reason
            continue
        try:
            methods |= _variants(entry, scene, num_threads, device)
        except NotForThisScene as error:
            skipped[entry.name] = str(error)
        except Exception as error:
            skipped[entry.name] = f"fails: {type(error).__name__}: {error}".splitlines()[0]
    return methods, skipped


def _why_not(entry: Entry, device: str) -> str:
    kind = device.split(":")[0]
    if kind not in entry.devices:
        return f"does not run on {kind}"
    if missing := entry.missing():
        return f"not installed ({', '.join(missing)}): pip install {entry.package}"
    return ""


def _variants(entry: Entry, scene: BenchmarkScene, num_threads: int, device: str) -> dict[str, Method]:
    """The method as it is, and once more with its environments split over threads if it does not do so itself."""
    if entry.shared_scan:
        phases = np.full_like(scene.scan.phase_rows, scene.scan.phase_rows[0])
        scene = replace(scene, scan=replace(scene.scan, phase_rows=phases))
    methods: dict[str, Method] = {entry.name: entry.build(scene, num_threads if entry.own_threads else 1, device)}
    if not entry.own_threads and num_threads > 1 and device == "cpu" and scene.num_envs > 1:
        methods[f"{entry.name}, {num_threads} threads"] = SplitMethod(entry.build, scene, num_threads, device)
    for method in methods.values():
        method.cast(0)
    return methods
