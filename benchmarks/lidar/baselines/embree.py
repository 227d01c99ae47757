"""Embree, through embreex and through Open3D."""

from __future__ import annotations

import numpy as np

from ..methods import NotForThisScene, finite_ranges
from ..scenes import BenchmarkScene, environment_mesh


class Embree:
    """One Embree scene of triangles per environment, built once and not counted: for scenes that stand still."""

    rotates_rays = False

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        if scene.moving:
            raise NotForThisScene("only for scenes that stand still")
        self.scene = scene
        self._scenes, self._meshes = [], []
        for env in range(scene.num_envs if scene.num_bodies else 1):
            self._scenes.append(EmbreeScene())
            vertices, faces = environment_mesh(scene, 0, env)
            self._meshes.append(TriangleMesh(self._scenes[-1], vertices.astype(np.float32), faces))
        # One call for each Embree scene; a scene that all environments share takes all their rays at once.
        count = len(self._scenes)
        self._rays = []
        for frame in range(scene.num_frames):
            directions = scene.directions_w(frame)
            origins = np.broadcast_to(scene.sensor_pos[frame, :, None], directions.shape)
            self._rays.append([np.ascontiguousarray(rays).reshape(count, -1, 3) for rays in (origins, directions)])
        self._distances = np.zeros((count, scene.num_envs * scene.num_rays // count), dtype=np.float32)

    def cast(self, frame: int) -> None:
        origins, directions = self._rays[frame % self.scene.num_frames]
        for k, scene in enumerate(self._scenes):
            self._distances[k] = scene.run(origins[k], directions[k], query="DISTANCE")

    def ranges(self) -> np.ndarray:
        return finite_ranges(self._distances.reshape(self.scene.num_envs, -1), self.scene.max_range)


class Open3D:
    """Open3D's ``RaycastingScene``, which cannot be updated: built again for each frame where something moves."""

    rotates_rays = False

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        import open3d

        self.scene, self._o3d, self._num_threads = scene, open3d, num_threads
        self._rays = []
        for frame in range(scene.num_frames):
            directions = scene.directions_w(frame)
            origins = np.broadcast_to(scene.sensor_pos[frame, :, None], directions.shape)
            self._rays.append(np.concatenate([origins, directions], axis=-1))
        envs = range(scene.num_envs if scene.num_bodies else 1)
        self._triangles = [[environment_mesh(scene, frame, env) for env in envs] for frame in range(scene.num_frames)]
        self._scenes = None if scene.moving else self._build(0)
        self._distances = np.zeros(self._rays[0].shape[:2], dtype=np.float32)

    def cast(self, frame: int) -> None:
        pose = frame % self.scene.num_frames
        rays = self._rays[pose].reshape(len(self._triangles[pose]), -1, 6)
        out = self._distances.reshape(rays.shape[:2])
        for k, scene in enumerate(self._scenes or self._build(pose)):
            out[k] = scene.cast_rays(self._o3d.core.Tensor(rays[k]), self._num_threads)["t_hit"].numpy()

    def ranges(self) -> np.ndarray:
        return finite_ranges(self._distances, self.scene.max_range)

    def _build(self, frame: int) -> list:
        scenes = []
        for vertices, faces in self._triangles[frame]:
            scene = self._o3d.t.geometry.RaycastingScene(nthreads=self._num_threads)
            arrays = vertices.astype(np.float32), faces.astype(np.uint32)
            scene.add_triangles(*(self._o3d.core.Tensor(array) for array in arrays))
            scenes.append(scene)
        return scenes
