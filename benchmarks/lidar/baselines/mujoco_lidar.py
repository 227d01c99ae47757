"""The package mujoco-lidar, each of its backends. It takes the same scan angles for all environments."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np

from benchmarks.harness.reference import compile_model
from benchmarks.harness.rotations import matrices

from ..methods import Baseline
from ..scenes import BenchmarkScene


class _MujocoLidar(Baseline):
    """Poses as rotation matrices, rays as angles. The ground is a finite plane: the Taichi backend bounds an infinite
    one by a box without extent, so that no ray ever reaches it."""

    rotates_rays = True

    def __init__(self, scene: BenchmarkScene) -> None:
        super().__init__(scene)
        self.model = compile_model(scene, plane_size=2.0 * scene.max_range)
        self.sensor_mat = matrices(scene.sensor_quat).astype(np.float32)
        directions = [scene.scan.directions_s(frame)[0].astype(np.float64) for frame in range(scene.num_frames)]
        self.azimuth = [np.arctan2(d[:, 1], d[:, 0]).astype(np.float32) for d in directions]
        self.elevation = [np.arcsin(d[:, 2]).astype(np.float32) for d in directions]


class _Batched(_MujocoLidar):
    """Backends that trace all environments in one call."""

    def __init__(self, scene: BenchmarkScene) -> None:
        super().__init__(scene)
        shape, ground = (scene.num_frames, scene.num_envs, self.model.ngeom), int(scene.plane)
        self.geom_pos = np.zeros((*shape, 3), dtype=np.float32)
        self.geom_mat = np.broadcast_to(np.eye(3, dtype=np.float32), (*shape, 3, 3)).copy()
        self.geom_pos[:, :, ground:] = scene.positions
        self.geom_mat[:, :, ground:] = matrices(scene.quats)

    def _cast(self, pose: int) -> None:
        geoms = (self.geom_pos[pose], self.geom_mat[pose])
        sensor = (self.scene.sensor_pos[pose], self.sensor_mat[pose])
        self._distances, _ = self._lidar.trace_rays_batch(*geoms, *sensor, self.azimuth[pose], self.elevation[pose])


class WarpBackend(_Batched):
    """All environments in one call; with a tree over each environment's bounds, which is refitted, or without."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str, tree: bool = True) -> None:
        from mujoco_lidar.core_warp.mjlidar_warp import MjLidarWarp

        super().__init__(scene)
        self._lidar = MjLidarWarp(self.model, cutoff_dist=scene.max_range, device=device, use_bvh=tree)


class JaxBackend(_Batched):
    """All environments in one compiled call, every ray against every shape."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        from mujoco_lidar.core_jax.mjlidar_jax import MjLidarJax

        super().__init__(scene)
        self._lidar = MjLidarJax(self.model)

    def _cast(self, pose: int) -> None:
        super()._cast(pose)
        self._distances.block_until_ready()


class _OneByOne(_MujocoLidar):
    """Backends that know one scene at a time: a loop over environments with MuJoCo's kinematics in front."""

    def __init__(self, scene: BenchmarkScene) -> None:
        super().__init__(scene)
        self._data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self._data)
        self._distances = np.zeros((scene.num_envs, scene.num_rays))
        self._sensor = np.broadcast_to(np.eye(4), (*self.sensor_mat.shape[:2], 4, 4)).astype(np.float32).copy()
        self._sensor[..., :3, :3], self._sensor[..., :3, 3] = self.sensor_mat, scene.sensor_pos
        self._angles: list[tuple] = list(zip(self.azimuth, self.elevation, strict=True))

    def _cast(self, pose: int) -> None:
        for env in range(self.scene.num_envs):
            self._data.mocap_pos[:] = self.scene.positions[pose, env]
            self._data.mocap_quat[:] = self.scene.quats[pose, env]
            mujoco.mj_kinematics(self.model, self._data)
            self._lidar.update(self._data)
            self._lidar.trace_rays(self._sensor[pose, env], *self._angles[pose])
            self._distances[env] = self._lidar.get_distances()


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

        def uploaded(values: np.ndarray):
            array = ti.ndarray(ti.f32, shape=len(values))
            array.from_numpy(values)
            return array

        super().__init__(scene)
        self._lidar = MjLidarTi(self.model, cutoff_dist=scene.max_range)
        self._angles = [tuple(map(uploaded, angles)) for angles in self._angles]


@cache
def _start_taichi(num_threads: int) -> None:
    """Starts Taichi once; starting it again would pull the fields from under what exists."""
    import taichi as ti

    ti.init(arch=ti.cpu, cpu_max_num_threads=num_threads, log_level=ti.ERROR, offline_cache=False)
