"""The paper's scheme: one global mesh of everything that moves in all environments, refitted for each frame.

Environments lie side by side in one world, as far apart as it takes for no ray to reach a neighbour's obstacles. What
stands still is a second mesh. One thread per ray.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from benchmarks.harness.meshes import join, tessellate

from ..methods import finite_ranges
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


class OneMesh:
    """One refitted mesh, on one thread or with the rays split over several."""

    rotates_rays = False

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        self.scene, self._device = scene, device
        offsets = self._environment_offsets()
        self._static = self._static_mesh(offsets)
        self._poses = [self._world_poses(frame, offsets) for frame in range(scene.num_frames)]
        self._dynamic = self._dynamic_mesh() if scene.num_bodies else None
        self._origins, self._directions = [], []
        for frame in range(scene.num_frames):
            directions = scene.directions_w(frame)
            origins = np.broadcast_to((scene.sensor_pos[frame] + offsets)[:, None], directions.shape)
            self._origins.append(self._upload(origins.reshape(-1, 3), wp.vec3))
            self._directions.append(self._upload(directions.reshape(-1, 3), wp.vec3))
        self._ranges = wp.zeros(scene.num_envs * scene.num_rays, dtype=wp.float32, device=device)

    def cast(self, frame: int) -> None:
        pose = frame % self.scene.num_frames
        if self._dynamic is not None and self.scene.moving:
            self._move(pose)
            self._dynamic.refit()
        wp.launch(
            cast_rays,
            dim=len(self._ranges),
            inputs=[
                self._static.id if self._static else wp.uint64(0),
                self._dynamic.id if self._dynamic else wp.uint64(0),
                self._origins[pose],
                self._directions[pose],
                self.scene.max_range,
                self._ranges,
            ],
            device=self._device,
        )

    def ranges(self) -> np.ndarray:
        ranges = self._ranges.numpy().reshape(self.scene.num_envs, self.scene.num_rays)
        return finite_ranges(ranges, self.scene.max_range)

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
        return self._mesh(vertices, faces)

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

    def _mesh(self, vertices: np.ndarray, faces: np.ndarray) -> wp.Mesh:
        return wp.Mesh(points=self._upload(vertices, wp.vec3), indices=self._upload(faces.ravel(), wp.int32))

    def _upload(self, values: np.ndarray, dtype: type) -> wp.array:
        values = np.ascontiguousarray(values, dtype=np.int32 if dtype is wp.int32 else np.float32)
        return wp.array(values, dtype=dtype, device=self._device)
