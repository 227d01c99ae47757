"""Embree, through embreex and through Open3D."""

from __future__ import annotations

import numpy as np

from ..methods import Baseline, NotForThisScene
from ..scenes import BenchmarkScene, environment_mesh


class _Triangles(Baseline):
    """One scene of triangles per environment; environments that see nothing but the ground share one."""

    sees_terrain = True

    def __init__(self, scene: BenchmarkScene) -> None:
        super().__init__(scene)
        self._count = scene.num_envs if scene.num_bodies else 1
        self._distances = np.zeros((self._count, scene.num_envs * scene.num_rays // self._count), dtype=np.float32)

    def _meshes(self, frame: int) -> list[tuple[np.ndarray, np.ndarray]]:
        meshes = [environment_mesh(self.scene, frame, env) for env in range(self._count)]
        return [(vertices.astype(np.float32), faces) for vertices, faces in meshes]


class Embree(_Triangles):
    """Built once and not counted: for scenes that stand still."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        if scene.moving:
            raise NotForThisScene("only for scenes that stand still")
        super().__init__(scene)
        self._scenes = [EmbreeScene() for _ in range(self._count)]
        self._kept = [TriangleMesh(s, *mesh) for s, mesh in zip(self._scenes, self._meshes(0), strict=True)]
        self._rays = [
            [np.ascontiguousarray(vectors).reshape(self._count, -1, 3) for vectors in rays] for rays in scene.rays_w()
        ]

    def _cast(self, pose: int) -> None:
        origins, directions = self._rays[pose]
        for k, scene in enumerate(self._scenes):
            self._distances[k] = scene.run(origins[k], directions[k], query="DISTANCE")


class Open3D(_Triangles):
    """Open3D's ``RaycastingScene``, which cannot be updated: built again for each frame where something moves."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        import open3d

        super().__init__(scene)
        self._o3d, self._num_threads = open3d, num_threads
        self._rays = [np.concatenate(rays, axis=-1).reshape(self._count, -1, 6) for rays in scene.rays_w()]
        self._triangles = [self._meshes(frame) for frame in range(scene.num_frames if scene.moving else 1)]
        self._place(0)

    def _cast(self, pose: int) -> None:
        for k, scene in enumerate(self._scenes):
            rays = self._o3d.core.Tensor(self._rays[pose][k])
            self._distances[k] = scene.cast_rays(rays, self._num_threads)["t_hit"].numpy()

    def _place(self, pose: int) -> None:
        self._scenes = []
        for vertices, faces in self._triangles[pose]:
            scene = self._o3d.t.geometry.RaycastingScene(nthreads=self._num_threads)
            scene.add_triangles(self._o3d.core.Tensor(vertices), self._o3d.core.Tensor(faces.astype(np.uint32)))
            self._scenes.append(scene)
