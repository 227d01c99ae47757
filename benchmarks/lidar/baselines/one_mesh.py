"""The paper's scheme: one global mesh of everything that moves in all environments, refitted for each frame.

Environments lie side by side in one world, as far apart as it takes for no ray to reach a neighbour's obstacles. What
stands still is a second mesh. One thread per ray.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from benchmarks.harness.meshes import join, tessellate

from ..methods import Baseline
from ..scenes import AREA, BenchmarkScene, ground_mesh

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def move_vertices(
    local: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    poses: wp.array(dtype=wp.transform),
    # out
    vertices_out: wp.array(dtype=wp.vec3),
):
    """Carries one vertex to where its body is."""
    vertex = wp.tid()
    vertices_out[vertex] = wp.transform_point(poses[body[vertex]], local[vertex])


@wp.kernel(enable_backward=False)
def cast_rays(
    static_mesh: wp.uint64,
    dynamic_mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    max_range: float,
    # out
    ranges_out: wp.array(dtype=wp.float32),
):
    """Casts one ray through the static mesh and through the moving one."""
    ray = wp.tid()
    best = max_range
    found = bool(False)  # noqa: UP018  (declares a variable that may change)
    if static_mesh != wp.uint64(0):
        ground_hit = wp.mesh_query_ray(static_mesh, origins[ray], directions[ray], best)
        if ground_hit.result:
            best = ground_hit.t
            found = True
    if dynamic_mesh != wp.uint64(0):
        hit = wp.mesh_query_ray(dynamic_mesh, origins[ray], directions[ray], best)
        if hit.result:
            best = hit.t
            found = True
    ranges_out[ray] = wp.where(found, best, -1.0)


class OneMesh(Baseline):
    """One refitted mesh, on one thread or with the rays split over several."""

    sees_terrain = True

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        super().__init__(scene)
        self._device = device
        offsets = self._environment_offsets()
        self._static = self._static_mesh(offsets)
        self._poses = [self._world_poses(frame, offsets) for frame in range(scene.num_frames)]
        self._dynamic = self._dynamic_mesh() if scene.num_bodies else None
        self._rays = [
            [self._upload(vectors.reshape(-1, 3), wp.vec3) for vectors in (origins + offsets[:, None], directions)]
            for origins, directions in scene.rays_w()
        ]
        self._distances = wp.zeros(scene.num_envs * scene.num_rays, dtype=wp.float32, device=device)

    def _cast(self, pose: int) -> None:
        meshes = [mesh.id if mesh else wp.uint64(0) for mesh in (self._static, self._dynamic)]
        inputs = [*meshes, *self._rays[pose], self.scene.max_range, self._distances]
        wp.launch(cast_rays, dim=len(self._distances), inputs=inputs, device=self._device)

    def _place(self, pose: int) -> None:
        if self._dynamic is not None:
            self._move(pose)
            self._dynamic.refit()

    def _environment_offsets(self) -> np.ndarray:
        """Origins of the environments in the common world, (num_envs, 3) float32; all the same over one terrain."""
        scene = self.scene
        if not scene.num_bodies:
            return np.zeros((scene.num_envs, 3), dtype=np.float32)
        side = math.ceil(math.sqrt(scene.num_envs))
        reach = float(np.abs(scene.positions[..., :2]).max(initial=AREA)) + 2.0
        spacing = scene.max_range + reach
        index = np.arange(scene.num_envs)
        place = np.stack([index % side, index // side, np.zeros_like(index)], axis=1) * spacing
        return place.astype(np.float32)

    def _static_mesh(self, offsets: np.ndarray) -> wp.Mesh | None:
        parts = ground_mesh(self.scene)
        if not parts:
            return None
        vertices, faces = parts[0]
        if self.scene.plane:  # one square under all environments
            low, high = offsets.min(axis=0), offsets.max(axis=0)
            vertices = vertices + np.where(vertices > 0.0, high, low) * (1.0, 1.0, 0.0)
        return wp.Mesh(self._upload(vertices, wp.vec3), self._upload(faces.ravel(), wp.int32))

    def _dynamic_mesh(self) -> wp.Mesh:
        scene = self.scene
        shapes = [tessellate(kind, size) for kind, size in zip(scene.kinds, scene.sizes, strict=True)]
        local, faces = join(shapes * scene.num_envs)
        counts = [len(vertices) for vertices, _ in shapes] * scene.num_envs
        self._local = self._upload(local, wp.vec3)
        self._body = self._upload(np.repeat(np.arange(len(counts), dtype=np.int32), counts), wp.int32)
        self._vertices = wp.zeros(len(local), dtype=wp.vec3, device=self._device)
        self._move(0)
        return wp.Mesh(points=self._vertices, indices=self._upload(faces.ravel(), wp.int32))

    def _move(self, pose: int) -> None:
        inputs = [self._local, self._body, self._poses[pose], self._vertices]
        wp.launch(move_vertices, dim=len(self._vertices), inputs=inputs, device=self._device)

    def _world_poses(self, frame: int, offsets: np.ndarray) -> wp.array:
        positions = self.scene.positions[frame] + offsets[:, None]
        poses = np.concatenate([positions, np.roll(self.scene.quats[frame], -1, axis=-1)], axis=-1)
        return self._upload(poses.reshape(-1, 7), wp.transform)

    def _upload(self, values: np.ndarray, dtype: type) -> wp.array:
        values = np.ascontiguousarray(values, dtype=np.int32 if dtype is wp.int32 else np.float32)
        return wp.array(values, dtype=dtype, device=self._device)
