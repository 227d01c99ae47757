"""The package mujoco-lidar, each of its backends. It takes the same scan angles for all environments."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np

from benchmarks.harness.reference import compile_model
from benchmarks.harness.rotations import matrices

from ..methods import NotForThisScene, finite_ranges
from ..scenes import BenchmarkScene


class _MujocoLidar:
    """Poses as rotation matrices, rays as angles. The ground is a finite plane: the Taichi backend bounds an infinite
    one by a box without extent, so that no ray ever reaches it."""

    rotates_rays = True

    def __init__(self, scene: BenchmarkScene) -> None:
        if scene.terrain is not None:
            raise NotForThisScene("triangles are not compared here")
        self.scene = scene
        self.model = compile_model(scene, plane_size=2.0 * scene.max_range)
        shape = (scene.num_frames, scene.num_envs)
        ground = int(scene.plane)
        self.geom_pos = np.zeros((*shape, self.model.ngeom, 3), dtype=np.float32)
        self.geom_mat = np.broadcast_to(np.eye(3, dtype=np.float32), (*self.geom_pos.shape, 3)).copy()
        self.geom_pos[:, :, ground:] = scene.positions
        self.geom_mat[:, :, ground:] = matrices(scene.quats)
        self.sensor_mat = matrices(scene.sensor_quat).astype(np.float32)
        one = replace(scene.scan, phase_rows=scene.scan.phase_rows[:1])
        directions = [one.directions_s(f)[0].astype(np.float64) for f in range(scene.num_frames)]
        self.azimuth = [np.arctan2(d[:, 1], d[:, 0]).astype(np.float32) for d in directions]
        self.elevation = [np.arcsin(d[:, 2]).astype(np.float32) for d in directions]

    def ranges(self) -> np.ndarray:
        return finite_ranges(self._distances, self.scene.max_range)


class _Batched(_MujocoLidar):
    """Backends that trace all environments in one call."""

    def _trace(self, frame: int):
        """Distances (m) of all rays, as the backend gives them."""
        pose = frame % self.scene.num_frames
        distances, _ = self._lidar.trace_rays_batch(
            self.geom_pos[pose],
            self.geom_mat[pose],
            self.scene.sensor_pos[pose],
            self.sensor_mat[pose],
            self.azimuth[pose],
            self.elevation[pose],
        )
        return distances


class WarpBackend(_Batched):
    """All environments in one call; with a tree over each environment's bounds, which is refitted, or without."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str, tree: bool = True) -> None:
        from mujoco_lidar.core_warp.mjlidar_warp import MjLidarWarp

        super().__init__(scene)
        self._lidar = MjLidarWarp(self.model, cutoff_dist=scene.max_range, device=device, use_bvh=tree)

    def cast(self, frame: int) -> None:
        self._distances = self._trace(frame)


class JaxBackend(_Batched):
    """All environments in one compiled call, every ray against every shape."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        from mujoco_lidar.core_jax.mjlidar_jax import MjLidarJax

        super().__init__(scene)
        self._lidar = MjLidarJax(self.model)

    def cast(self, frame: int) -> None:
        self._distances = self._trace(frame).block_until_ready()


class _OneByOne(_MujocoLidar):
    """Backends that know one scene at a time: a loop over environments with MuJoCo's kinematics in front."""

    def __init__(self, scene: BenchmarkScene) -> None:
        super().__init__(scene)
        self._data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self._data)
        self._distances = np.zeros((scene.num_envs, scene.num_rays))
        self._sensor = np.broadcast_to(np.eye(4), (*self.sensor_mat.shape[:2], 4, 4)).astype(np.float32).copy()
        self._sensor[..., :3, :3], self._sensor[..., :3, 3] = self.sensor_mat, scene.sensor_pos

    def cast(self, frame: int) -> None:
        pose = frame % self.scene.num_frames
        azimuth, elevation = self._angles(pose)
        for env in range(self.scene.num_envs):
            self._data.mocap_pos[:] = self.scene.positions[pose, env]
            self._data.mocap_quat[:] = self.scene.quats[pose, env]
            mujoco.mj_kinematics(self.model, self._data)
            self._lidar.update(self._data)
            self._lidar.trace_rays(self._sensor[pose, env], azimuth, elevation)
            self._distances[env] = self._lidar.get_distances()

    def _angles(self, pose: int) -> tuple:
        return self.azimuth[pose], self.elevation[pose]


class CpuBackend(_OneByOne):
    """``mj_multiRay`` in float64."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        from mujoco_lidar.core_cpu.mjlidar_cpu import MjLidarCPU

        super().__init__(scene)
        self._lidar = MjLidarCPU(self.model, cutoff_dist=scene.max_range)


class TaichiBackend(_OneByOne):
    """Taichi with a tree that is rebuilt for each environment."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        import taichi as ti

        _start_taichi(num_threads)
        from mujoco_lidar.core_ti.mjlidar_ti import MjLidarTi

        super().__init__(scene)
        self._lidar = MjLidarTi(self.model, cutoff_dist=scene.max_range)
        self._ti_angles = []
        for angles in zip(self.azimuth, self.elevation, strict=True):
            arrays = tuple(ti.ndarray(ti.f32, shape=scene.num_rays) for _ in angles)
            for array, values in zip(arrays, angles, strict=True):
                array.from_numpy(values)
            self._ti_angles.append(arrays)

    def _angles(self, pose: int) -> tuple:
        return self._ti_angles[pose]


@cache
def _start_taichi(num_threads: int) -> None:
    """Starts Taichi once; starting it again would pull the fields from under what exists."""
    import taichi as ti

    ti.init(arch=ti.cpu, cpu_max_num_threads=num_threads, log_level=ti.ERROR, offline_cache=False)
