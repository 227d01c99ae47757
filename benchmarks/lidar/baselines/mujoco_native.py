"""MuJoCo's own rays on its native thread pool, in float64: ``mujoco.batch.Batch.ray``."""

from __future__ import annotations

import numpy as np
from mujoco.batch import Batch

from benchmarks.harness.reference import compile_model

from ..methods import Baseline
from ..scenes import BenchmarkScene


class BatchRay(Baseline):
    """Poses are written as mocap poses; the call itself runs the kinematics."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        super().__init__(scene)
        self._batch = Batch(compile_model(scene), scene.num_envs, num_threads)
        self._pos, self._quat = self._batch.bind("mocap_pos"), self._batch.bind("mocap_quat")
        self._rays = scene.rays_w(np.float64)
        self._place(0)

    def _cast(self, pose: int) -> None:
        self._distances, _ = self._batch.ray(*self._rays[pose])

    def _place(self, pose: int) -> None:
        self._pos[:], self._quat[:] = self.scene.positions[pose], self.scene.quats[pose]
