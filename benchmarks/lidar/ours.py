"""The benchmark's only door to ``omnilidar``."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache, partial

import numpy as np
import torch

import omnilidar as lidar
from benchmarks.harness.memory import buffer_bytes
from benchmarks.harness.meshes import tessellate_to
from benchmarks.harness.reference import Shapes

from .methods import Entry
from .scenes import BenchmarkScene, Scan, Terrain


def mid360_scan(num_envs: int, num_rays: int = 1000, period_s: float = 0.1, seed: int = 0) -> Scan:
    """The Mid-360's rays with a phase of its own in each environment; every k-th of them, as the sensor keeps them."""
    pattern = _mid360()
    shots = pattern.num_rows // pattern.rows_per_shot
    angles = (angle.double().numpy() for angle in (pattern.elevation, pattern.azimuth))
    return Scan(
        *angles,
        points_per_second=pattern.points_per_second,
        num_lasers=pattern.num_lasers,
        num_rays=num_rays,
        stride=pattern.stride(period_s, num_rays),
        period_s=period_s,
        rows_per_shot=pattern.rows_per_shot,
        phase_rows=np.random.default_rng(seed).integers(0, shots, num_envs) * pattern.rows_per_shot,
    )


@cache
def _mid360() -> lidar.ScanPattern:
    return lidar.mid360()


def long_scan(num_envs: int, num_rays: int, seed: int = 0) -> Scan:
    """Any number of consecutive Mid-360 rays: a frame lasts as long as the device needs for them."""
    pattern = _mid360()
    return mid360_scan(num_envs, num_rays, max(num_rays / pattern.points_per_second, 0.1), seed)


class Ours:
    """``omnilidar``; the sensor rides on body 0, the obstacles are the bodies after it."""

    rotates_rays = True

    def __init__(self, scene: BenchmarkScene, num_threads: int, device: str, terrain: str = "mesh", **features) -> None:
        self.scene = scene
        self.rays = build_rays(scene, num_threads, device, terrain)
        poses = ((scene.sensor_pos, scene.positions), (scene.sensor_quat, scene.quats))
        joined = (np.concatenate([sensor[:, :, None], obstacles], axis=2) for sensor, obstacles in poses)
        self._pos, self._quat = (torch.from_numpy(pose).to(device) for pose in joined)
        self.lidar = build_lidar(self.rays, scene, **features)
        self._place(0)

    def cast(self, frame: int) -> None:
        frame = frame % self.scene.num_frames
        for _ in range(1, self.lidar.config.motion_segments):
            self.lidar.record_poses()
        if self.scene.moving:
            self._place(frame)
        self.frame = self.lidar.cast(self._time(frame))

    def ranges(self) -> np.ndarray:
        return self.frame.ranges.cpu().double().numpy()

    def _place(self, pose: int) -> None:
        self.rays.body_pos.copy_(self._pos[pose])
        self.rays.body_quat.copy_(self._quat[pose])

    def _time(self, frame: int) -> torch.Tensor:
        time = (frame + 1) * self.scene.scan.period_s
        return torch.full((self.scene.num_envs,), time, dtype=torch.float64, device=self.rays.device)


OURS_NAME = "ours"
TERRAIN_FORMS = ("mesh", "height field")
OURS = Entry(OURS_NAME, Ours, own_threads=True, devices=("cpu", "cuda"))


def terrain_entries() -> list[Entry]:
    """Ours with a terrain in each of the forms in which it can be given."""
    return [replace(OURS, name=f"{OURS_NAME}, {form}", build=partial(Ours, terrain=form)) for form in TERRAIN_FORMS]


def feature_cases() -> dict[str, dict]:
    """Every single feature that can be asked for beside the ranges: arguments of ``build_lidar`` by name."""
    noises = {
        "mask noise": lidar.MaskNoise(),
        "distance noise": lidar.DistanceNoise(),
        "range-dependent Gaussian noise": lidar.GaussianNoise(0.02, 0.001),
        "angular jitter": lidar.AngularJitter(0.05),
        "dropout": lidar.Dropout(0.05, 0.001),
        "mixed pixels": lidar.MixedPixels(),
        "noise and dropout by range": lidar.TabulatedNoise((0.2, 2.0, 20.0), (0.01, 0.02), (0.02, 0.1), 0.02),
    }
    cases = {f"output {name}": {"outputs": ("ranges", name)} for name in lidar.OUTPUTS if name != "ranges"}
    cases["all outputs"] = {"outputs": lidar.OUTPUTS}
    cases |= {name: {"noise": (noise,)} for name, noise in noises.items()}
    cases["all noise"] = {"noise": tuple(noises.values())}
    cases |= {f"motion distortion, {k} pieces": {"motion_segments": k} for k in (1, 5)}
    cases["stratified selection of rays"] = {"selection": "stratified"}
    return cases


def build_rays(scene: BenchmarkScene, num_threads: int, device: str, terrain: str = "mesh") -> lidar.RayScene:
    """The shapes of a scene: ground first, then obstacle k on body k + 1."""
    shapes = [lidar.Shape(lidar.ShapeKind.PLANE)] if scene.plane else []
    if scene.terrain is not None:
        shapes.append(_ground(scene.terrain, terrain))
    shapes += obstacle_shapes(scene, first_body=1)
    return lidar.RayScene(shapes, scene.num_envs, scene.num_bodies + 1, device, num_threads)


def obstacle_shapes(scene: Shapes, triangles: int = 0, first_body: int = 0, class_id: int = 0) -> list[lidar.Shape]:
    """A scene's obstacles, each on a body of its own: exact, or of about so many triangles."""
    shapes = []
    for body, (kind, size) in enumerate(zip(scene.kinds, scene.sizes.astype(float), strict=True), first_body):
        if triangles:
            mesh = lidar.TriangleMesh(*tessellate_to(kind, size, triangles))
            shapes.append(lidar.Shape(lidar.ShapeKind.MESH, asset=mesh, body=body, class_id=class_id))
        else:
            exact = lidar.ShapeKind[kind.upper()]
            shapes.append(lidar.Shape(exact, tuple(size[size > 0.0]), body=body, class_id=class_id))
    return shapes


def _ground(terrain: Terrain, form: str) -> lidar.Shape:
    """A mesh or a height field, whose rows go along y and whose heights start at 0."""
    if form == "mesh":
        return lidar.Shape(lidar.ShapeKind.MESH, asset=lidar.TriangleMesh(terrain.vertices, terrain.faces))
    lowest = float(terrain.heights.min())
    field = lidar.HeightField(terrain.heights.T.astype(np.float64) - lowest, *terrain.size)
    return lidar.Shape(lidar.ShapeKind.HEIGHTFIELD, asset=field, pos=(0.0, 0.0, lowest))


def build_lidar(rays: lidar.RayScene, scene: BenchmarkScene, **features) -> lidar.Lidar:
    """A sensor on body 0 that casts the rays of the scene's scan; ``features`` of ``LidarConfig`` or ``Lidar``."""
    scan = scene.scan
    pattern = lidar.ScanPattern.from_angles(
        scan.elevation, scan.azimuth, scan.points_per_second, scan.num_lasers, rows_per_shot=scan.rows_per_shot
    )
    configured = {field.name: features.pop(field.name) for field in fields(lidar.LidarConfig) if field.name in features}
    config = lidar.LidarConfig(scan.num_rays, scan.period_s, min_range=0.0, max_range=scene.max_range, **configured)
    sensor = lidar.Lidar(config, pattern, rays, mount_body=0, **features)
    sensor.phase_rows.copy_(torch.from_numpy(scan.phase_rows))
    return sensor


def buffer_sizes(scene: BenchmarkScene, **features) -> tuple[int, int]:
    """Bytes that each further environment adds to our buffers, and bytes that all of them share.

    Shared are the scan's table, the shapes, and the trees of meshes.
    """
    sizes = []
    for num_envs in (1, 2):
        ours = Ours(scene.repeated(num_envs), 1, "cpu", **features)
        sizes.append(buffer_bytes(ours.rays, ours.lidar))
    per_env = sizes[1] - sizes[0]
    return per_env, sizes[0] - per_env
