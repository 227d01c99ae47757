"""MuJoCo's own rays on its native thread pool, in float64: ``mujoco.batch.Batch.ray``."""

from __future__ import annotations

import numpy as np
from mujoco.batch import Batch

from benchmarks.harness.reference import compile_model

from ..methods import NotForThisScene, finite_ranges
from ..scenes import BenchmarkScene


class BatchRay:
    """Poses are written as mocap poses; the call itself runs the kinematics."""

    rotates_rays = False

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        if scene.terrain is not None:
            raise NotForThisScene("triangles are not compared here")
        self.scene = scene
        self._batch = Batch(compile_model(scene), scene.num_envs, num_threads)
        self._pos, self._quat = self._batch.bind("mocap_pos"), self._batch.bind("mocap_quat")
        frames = range(scene.num_frames)
        self._rays = [scene.directions_w(f).astype(np.float64) for f in frames]
        self._origins = [np.broadcast_to(scene.sensor_pos[f, :, None], self._rays[f].shape) for f in frames]
        self._origins = [origins.astype(np.float64) for origins in self._origins]
        self._place(0)

    def cast(self, frame: int) -> None:
        pose = frame % self.scene.num_frames
        if self.scene.moving:
            self._place(pose)
        self._distances, self._geoms = self._batch.ray(self._origins[pose], self._rays[pose])

    def ranges(self) -> np.ndarray:
        return finite_ranges(self._distances, self.scene.max_range)

    def _place(self, pose: int) -> None:
        self._pos[:] = self.scene.positions[pose]
        self._quat[:] = self.scene.quats[pose]
