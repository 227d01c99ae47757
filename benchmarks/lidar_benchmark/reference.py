"""The true ranges in float64, and how far a method is from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from .methods import Method
from .rotations import matrices
from .scenes import BenchmarkScene, Terrain

GROSS = 1e-3
"""A relative error beyond this is another surface, or a surface of another form."""


@dataclass(frozen=True)
class Errors:
    """How a method's ranges differ from the reference, over rays that were picked at random.

    Attributes:
        num_rays: Rays compared.
        median, p99, largest: Relative error over the rays that hit in both.
        gross: Share of those rays whose relative error is beyond ``GROSS``, percent.
        disagree: Share of all rays that hit in one and miss in the other, percent.
    """

    num_rays: int
    median: float
    p99: float
    largest: float
    gross: float
    disagree: float


def errors(ranges: np.ndarray, truth: np.ndarray) -> Errors:
    """Errors of ``ranges`` (N,) against ``truth`` (N,), metres, both infinite for a miss."""
    hit, true_hit = np.isfinite(ranges), np.isfinite(truth)
    both = hit & true_hit
    if not len(truth):
        raise ValueError("errors need at least one ray")
    disagree = 100.0 * float(np.mean(hit != true_hit))
    if not both.any():
        return Errors(len(truth), math.nan, math.nan, math.nan, math.nan, disagree)
    relative = np.abs(ranges[both] - truth[both]) / truth[both]
    median, p99 = (float(value) for value in np.quantile(relative, (0.5, 0.99)))
    return Errors(len(truth), median, p99, float(relative.max()), 100.0 * float(np.mean(relative > GROSS)), disagree)


class Reference:
    """Exact ranges through a scene: ``mj_ray`` in float64 for shapes, and the triangles of a terrain all one by one."""

    def __init__(self, scene: BenchmarkScene) -> None:
        self.scene = scene
        self.model = compile_model(scene)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    def ranges(self, frame: int, env: int, directions: np.ndarray) -> np.ndarray:
        """Ranges from the sensor of one environment, metres, ``inf`` beyond the scene's range and for a miss, (N,).

        Args:
            frame: Whose poses hold.
            env: The environment.
            directions: Unit directions in its frame, (N, 3) float64.
        """
        origin = self.scene.sensor_pos[frame, env].astype(np.float64)
        ranges = self._shape_ranges(frame, env, origin, directions)
        if self.scene.terrain is not None:
            ranges = np.minimum(ranges, terrain_ranges(self.scene.terrain, origin, directions))
        return np.where(ranges <= self.scene.max_range, ranges, math.inf)

    def _shape_ranges(self, frame: int, env: int, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        if not self.model.ngeom:
            return np.full(len(directions), math.inf)
        first = int(self.scene.plane)
        self.data.geom_xpos[first:] = self.scene.positions[frame, env]
        self.data.geom_xmat[first:] = matrices(self.scene.quats[frame, env]).reshape(-1, 9)
        geom = np.zeros((1, 1), dtype=np.int32)
        distances = [mujoco.mj_ray(self.model, self.data, origin, d, None, 1, -1, geom, None) for d in directions]
        return np.where(np.array(distances) < 0.0, math.inf, distances)


class Checker:
    """Compares methods with the reference along the same rays of one frame, picked at random over environments."""

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
        kind = (method.rotates_rays, scene.scan.phase_rows.tobytes())
        if kind not in self._truths:  # methods that cast the same rays share their truth
            self._truths[kind] = self._truth(scene, picked, np.float64 if method.rotates_rays else np.float32)
        return errors(np.concatenate([ranges[env, rays] for env, rays in picked]), self._truths[kind])

    def _picked(self, scene: BenchmarkScene) -> list[tuple[int, np.ndarray]]:
        """Environments and rays of each."""
        rng = np.random.default_rng(self.seed)
        num_envs = min(scene.num_envs, max(1, self.num_samples // 64))
        per_env = min(scene.num_rays, max(1, self.num_samples // num_envs))
        envs = rng.choice(scene.num_envs, num_envs, replace=False)
        return [(int(env), rng.choice(scene.num_rays, per_env, replace=False)) for env in envs]

    def _truth(self, scene: BenchmarkScene, picked: list[tuple[int, np.ndarray]], dtype: type) -> np.ndarray:
        reference, directions = Reference(scene), scene.directions_w(self.frame, dtype)
        return np.concatenate(
            [reference.ranges(self.frame, env, directions[env, rays].astype(np.float64)) for env, rays in picked]
        )


def compile_model(scene: BenchmarkScene, plane_size: float = 0.0) -> mujoco.MjModel:
    """The scene's shapes as a MuJoCo model: the plane, infinite or of this half side, and a mocap body per obstacle."""
    spec = mujoco.MjSpec()
    if scene.plane:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(plane_size, plane_size, 1.0))
    for kind, size in zip(scene.kinds, scene.sizes, strict=True):
        body = spec.worldbody.add_body(mocap=True)
        body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    return spec.compile()


def terrain_ranges(terrain: Terrain, origin: np.ndarray, directions: np.ndarray, chunk: int = 64) -> np.ndarray:
    """Distance from ``origin`` (3,) along each direction (N, 3) to the nearest of all triangles, float64, (N,).

    A ray passes through a triangle if it turns the same way about all three edges; neighbours share an edge's value, so
    nothing slips through between them.
    """
    corners = terrain.vertices.astype(np.float64)[terrain.faces] - np.asarray(origin, dtype=np.float64)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = [np.cross(a, b), np.cross(b, c), np.cross(c, a)]
    normal = np.cross(b - a, c - a)
    height = np.einsum("fi,fi->f", a, normal)
    ranges = np.empty(len(directions))
    for low in range(0, len(directions), chunk):
        d = directions[low : low + chunk].astype(np.float64)
        sides = [d @ edge.T for edge in edges]
        inside = np.all([s >= 0.0 for s in sides], axis=0) | np.all([s <= 0.0 for s in sides], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = height / (d @ normal.T)
        ranges[low : low + chunk] = np.where(inside & (t >= 0.0), t, math.inf).min(axis=1)
    return ranges
