"""Newton's ``intersect_ray`` and mujoco_warp's ``rays``: simulators with many worlds on NVIDIA Warp."""

from __future__ import annotations

import mujoco
import numpy as np
import warp as wp

from benchmarks.harness.reference import compile_model

from ..methods import NotForThisScene, finite_ranges
from ..scenes import BenchmarkScene


class Newton:
    """One world per environment and a ground shared by all; its tree is refitted for new poses."""

    rotates_rays = False

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        import newton

        if scene.terrain is not None:
            raise NotForThisScene("triangles are not compared here")
        self.scene, self._newton = scene, newton
        self.model = _newton_model(newton, scene).finalize(device=device)
        self._state = self.model.state()
        self._poses = [wp.array(_transforms(scene, f), dtype=wp.transform, device=device) for f in _frames(scene)]
        count = scene.num_envs * scene.num_rays
        self._origins, self._directions = _rays(scene, (count,), device)
        worlds = np.repeat(np.arange(scene.num_envs, dtype=np.int32), scene.num_rays)
        self._worlds = wp.array(worlds, dtype=wp.int32, device=device)
        self._distances = wp.empty(count, dtype=float, device=device)
        self._place(0)

    def cast(self, frame: int) -> None:
        pose = frame % self.scene.num_frames
        if self.scene.moving:
            self._place(pose)
        self._newton.intersect_ray(
            self.model,
            ray_origins=self._origins[pose],
            ray_directions=self._directions[pose],
            ray_worlds=self._worlds,
            out_dist=self._distances,
        )

    def ranges(self) -> np.ndarray:
        distances = self._distances.numpy().reshape(self.scene.num_envs, self.scene.num_rays)
        return finite_ranges(distances, self.scene.max_range)

    def _place(self, pose: int) -> None:
        if self.scene.num_bodies:
            wp.copy(self._state.body_q, self._poses[pose])
        self.model.bvh_refit_shapes(self._state)


class MujocoWarp:
    """mujoco_warp with the tree of its render context, refitted for new poses."""

    rotates_rays = False

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str) -> None:
        import mujoco_warp

        if scene.terrain is not None:
            raise NotForThisScene("triangles are not compared here")
        self.scene, self._mjw, self._device = scene, mujoco_warp, device
        model = compile_model(scene)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        shape = (scene.num_envs, scene.num_rays)
        with wp.ScopedDevice(device):
            self._model = mujoco_warp.put_model(model)
            self._data = mujoco_warp.put_data(model, data, nworld=scene.num_envs)
            self._tree = mujoco_warp.create_render_context(model, nworld=scene.num_envs)
            self._pos = [wp.array(scene.positions[f], dtype=wp.vec3) for f in _frames(scene)]
            self._quat = [wp.array(scene.quats[f], dtype=wp.quat) for f in _frames(scene)]
            self._origins, self._directions = _rays(scene, shape, device)
            self._excluded = wp.full(scene.num_rays, -1, dtype=int)
            self._distances = wp.empty(shape, dtype=float)
            self._geoms = wp.empty(shape, dtype=int)
            self._normals = wp.empty(shape, dtype=wp.vec3)
        self._place(0)

    def cast(self, frame: int) -> None:
        pose = frame % self.scene.num_frames
        if self.scene.moving:
            self._place(pose)
        everything = self._mjw._src.types.vec6(-1, -1, -1, -1, -1, -1)
        with wp.ScopedDevice(self._device):
            self._mjw.rays(
                self._model,
                self._data,
                self._origins[pose],
                self._directions[pose],
                everything,
                True,
                self._excluded,
                self._distances,
                self._geoms,
                self._normals,
                self._tree,
            )

    def ranges(self) -> np.ndarray:
        return finite_ranges(self._distances.numpy(), self.scene.max_range)

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


def _transforms(scene: BenchmarkScene, frame: int) -> np.ndarray:
    """Poses in Warp's order, quaternion (x, y, z, w), (num_envs * S, 7)."""
    poses = np.concatenate([scene.positions[frame], np.roll(scene.quats[frame], -1, axis=-1)], axis=-1)
    return poses.reshape(-1, 7)


def _rays(scene: BenchmarkScene, shape: tuple[int, ...], device: str) -> tuple[list[wp.array], list[wp.array]]:
    """Origins and directions of each frame, uploaded beforehand."""
    origins, directions = [], []
    for frame in _frames(scene):
        vectors = scene.directions_w(frame)
        starts = np.broadcast_to(scene.sensor_pos[frame, :, None], vectors.shape)
        directions.append(wp.array(vectors.reshape(*shape, 3), dtype=wp.vec3, device=device))
        origins.append(wp.array(starts.reshape(*shape, 3), dtype=wp.vec3, device=device))
    return origins, directions


def _frames(scene: BenchmarkScene) -> range:
    return range(scene.num_frames)
