"""Newton's ``intersect_ray`` and mujoco_warp's ``rays``: simulators with many worlds on NVIDIA Warp."""

from __future__ import annotations

import mujoco
import numpy as np
import warp as wp

from benchmarks.harness.reference import compile_model

from ..methods import Baseline
from ..scenes import BenchmarkScene


class Newton(Baseline):
    """One world per environment and a ground shared by all; its tree is refitted for new poses."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        import newton

        super().__init__(scene)
        self._newton = newton
        self.model = _newton_model(newton, scene).finalize(device=device)
        self._state = self.model.state()
        poses = np.concatenate([scene.positions, np.roll(scene.quats, -1, axis=-1)], axis=-1)  # quaternion (x, y, z, w)
        count = scene.num_envs * scene.num_rays
        worlds = np.repeat(np.arange(scene.num_envs, dtype=np.int32), scene.num_rays)
        with wp.ScopedDevice(device):
            self._poses = [wp.array(pose.reshape(-1, 7), dtype=wp.transform) for pose in poses]
            self._rays = [[wp.array(v.reshape(-1, 3), dtype=wp.vec3) for v in rays] for rays in scene.rays_w()]
            self._worlds, self._distances = wp.array(worlds), wp.empty(count, dtype=float)
        self._place(0)

    def _cast(self, pose: int) -> None:
        origins, directions = self._rays[pose]
        self._newton.intersect_ray(
            self.model,
            ray_origins=origins,
            ray_directions=directions,
            ray_worlds=self._worlds,
            out_dist=self._distances,
        )

    def _place(self, pose: int) -> None:
        if self.scene.num_bodies:
            wp.copy(self._state.body_q, self._poses[pose])
        self.model.bvh_refit_shapes(self._state)


class MujocoWarp(Baseline):
    """mujoco_warp with the tree of its render context, refitted for new poses."""

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        import mujoco_warp

        super().__init__(scene)
        self._mjw, self._device = mujoco_warp, device
        model = compile_model(scene)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        shape = (scene.num_envs, scene.num_rays)
        with wp.ScopedDevice(device):
            self._model = mujoco_warp.put_model(model)
            self._data = mujoco_warp.put_data(model, data, nworld=scene.num_envs)
            self._tree = mujoco_warp.create_render_context(model, nworld=scene.num_envs)
            self._pos = [wp.array(pos, dtype=wp.vec3) for pos in scene.positions]
            self._quat = [wp.array(quat, dtype=wp.quat) for quat in scene.quats]
            self._rays = [[wp.array(vectors, dtype=wp.vec3) for vectors in rays] for rays in scene.rays_w()]
            self._excluded = wp.full(scene.num_rays, -1, dtype=int)
            self._distances, geoms = wp.empty(shape, dtype=float), wp.empty(shape, dtype=int)
            self._out = (self._distances, geoms, wp.empty(shape, dtype=wp.vec3))
        self._place(0)

    def _cast(self, pose: int) -> None:
        everything = self._mjw._src.types.vec6(-1, -1, -1, -1, -1, -1)
        chosen = (*self._rays[pose], everything, True, self._excluded)
        with wp.ScopedDevice(self._device):
            self._mjw.rays(self._model, self._data, *chosen, *self._out, self._tree)

    def _place(self, pose: int) -> None:
        with wp.ScopedDevice(self._device):
            if self.scene.num_bodies:
                wp.copy(self._data.mocap_pos, self._pos[pose])
                wp.copy(self._data.mocap_quat, self._quat[pose])
            self._mjw.kinematics(self._model, self._data)
            self._mjw.refit_bvh(self._model, self._data, self._tree)


def _newton_model(newton, scene: BenchmarkScene):
    world = newton.ModelBuilder()
    for kind, size in zip(scene.kinds, scene.sizes.astype(float), strict=True):
        body = world.add_link(mass=1.0, is_kinematic=True)
        if kind == "box":
            world.add_shape_box(body, hx=size[0], hy=size[1], hz=size[2])
        elif kind == "sphere":
            world.add_shape_sphere(body, radius=size[0])
        else:
            add = world.add_shape_cylinder if kind == "cylinder" else world.add_shape_capsule
            add(body, radius=size[0], half_height=size[1])
    builder = newton.ModelBuilder()
    if scene.plane:
        builder.add_ground_plane()
    for _ in range(scene.num_envs):
        builder.add_world(world)
    return builder
