"""Interface of a ray-casting method, how its environments are split over threads, and its error."""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Protocol

import mujoco
import numpy as np

from benchmarks.harness.reference import Errors, compile_model, errors, mujoco_ranges, triangle_ranges

from .scenes import BenchmarkScene


class Method(Protocol):
    """One way of casting a scene's rays.

    Attributes:
        scene: what it casts; its scan may differ from the benchmark's where a method cannot take other rays.
        rotates_rays: whether it is given rays in the sensor frame and rotates them itself; otherwise it is given
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
        name: what reports call it.
        build: builds it for a scene.
        modules: modules that it needs.
        package: how to install them.
        own_threads: whether it spreads its work over threads itself; others get a row of their own with their
            environments split over threads.
        shared_scan: whether it takes the same rays for all environments only, those of the first.
        devices: kinds of devices on which it runs.
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
        self.scene, self.rotates_rays = scene, self.parts[0].rotates_rays
        self._pool = ThreadPoolExecutor(max(1, len(self.parts) - 1), thread_name_prefix="split")

    def cast(self, frame: int) -> None:
        helpers = [self._pool.submit(part.cast, frame) for part in self.parts[1:]]
        self.parts[0].cast(frame)
        for helper in helpers:
            helper.result()

    def ranges(self) -> np.ndarray:
        return np.concatenate([part.ranges() for part in self.parts])


class Baseline:
    """What adapters of others share: poses taken over where something moves, and misses as `inf`.

    An adapter has `_place(pose)` and `_cast(pose)`, which leaves `_distances`: negative or beyond the range for a miss.
    """

    rotates_rays = False
    sees_terrain = False

    def __init__(self, scene: BenchmarkScene) -> None:
        if scene.terrain is not None and not self.sees_terrain:
            raise NotForThisScene("triangles are not compared here")
        self.scene = scene

    def cast(self, frame: int) -> None:
        pose = frame % self.scene.num_frames
        if self.scene.moving:
            self._place(pose)
        self._cast(pose)

    def ranges(self) -> np.ndarray:
        found = self._distances.numpy() if hasattr(self._distances, "numpy") else self._distances
        distances = np.asarray(found, dtype=np.float64).reshape(self.scene.num_envs, -1)
        return np.where((distances < 0.0) | (distances > self.scene.max_range), np.inf, distances)

    def _place(self, pose: int) -> None:
        pass


def build_all(
    entries: Sequence[Entry], scene: BenchmarkScene, num_threads: int, device: str
) -> tuple[dict[str, Method], dict[str, str]]:
    """The methods that run here by name, each having cast a frame, and why each of the others was left out.

    A baseline that fails is named with its message rather than ending the run.
    """
    methods, skipped = {}, {}
    for entry in entries:
        if device.split(":")[0] not in entry.devices:
            skipped[entry.name] = f"does not run on {device.split(':')[0]}"
        elif missing := entry.missing():
            skipped[entry.name] = f"not installed ({', '.join(missing)}): pip install {entry.package}"
        else:
            try:
                methods |= _variants(entry, scene, num_threads, device)
            except NotForThisScene as error:
                skipped[entry.name] = str(error)
            except Exception as error:
                skipped[entry.name] = f"fails: {type(error).__name__}: {error}".splitlines()[0]
    return methods, skipped


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


class Checker:
    """Compares methods with exact ranges along the same rays of one frame, picked at random over environments."""

    def __init__(self, frame: int, num_samples: int, seed: int = 0) -> None:
        self.frame, self.num_samples, self.seed = frame, num_samples, seed
        self._truths: dict[tuple, np.ndarray] = {}

    def errors(self, method: Method) -> Errors:
        """Casts the frame with a method and compares its ranges."""
        scene = method.scene
        method.cast(self.frame)
        ranges = method.ranges()
        if ranges.shape != (scene.num_envs, scene.num_rays):
            raise ValueError(f"ranges {ranges.shape} must be {(scene.num_envs, scene.num_rays)}")
        picked = self._picked(scene)
        key = (method.rotates_rays, scene.scan.phase_rows.tobytes())
        if key not in self._truths:  # methods that cast the same rays share their truth
            directions = scene.directions_w(self.frame, np.float64 if method.rotates_rays else np.float32)
            rays = [(env, directions[env, chosen]) for env, chosen in picked]
            self._truths[key] = np.concatenate(true_ranges(scene, self.frame, rays))
        return errors(np.concatenate([ranges[env, rays] for env, rays in picked]), self._truths[key])

    def _picked(self, scene: BenchmarkScene) -> list[tuple[int, np.ndarray]]:
        """Environments and rays of each."""
        rng = np.random.default_rng(self.seed)
        num_envs = min(scene.num_envs, max(1, self.num_samples // 64))
        per_env = min(scene.num_rays, max(1, self.num_samples // num_envs))
        envs = rng.choice(scene.num_envs, num_envs, replace=False)
        return [(int(env), rng.choice(scene.num_rays, per_env, replace=False)) for env in envs]


def true_ranges(scene: BenchmarkScene, frame: int, rays: Sequence[tuple[int, np.ndarray]]) -> list[np.ndarray]:
    """Exact ranges from environments' sensors, m, ``inf`` for a miss: ``mj_ray``, and a terrain's triangles one by one.

    ``rays`` are environments and unit directions (N, 3) in their frames; the result has an (N,) for each.
    """
    model = compile_model(scene)
    data, found = mujoco.MjData(model), []
    for env, directions in rays:
        data.mocap_pos[:], data.mocap_quat[:] = scene.positions[frame, env], scene.quats[frame, env]
        mujoco.mj_kinematics(model, data)
        origin, directions = scene.sensor_pos[frame, env].astype(np.float64), directions.astype(np.float64)
        ranges, _ = mujoco_ranges(model, data, origin, directions)
        if scene.terrain is not None:
            triangles = scene.terrain.vertices[scene.terrain.faces]
            ranges = np.minimum(ranges, triangle_ranges(origin, directions, triangles))
        found.append(np.where(ranges <= scene.max_range, ranges, np.inf))
    return found
