"""One adapter per baseline; nothing of a baseline is imported before it is asked for."""

from __future__ import annotations

from functools import partial
from importlib import import_module

from ..methods import Build, Entry, Method
from ..scenes import BenchmarkScene


def _later(module: str, name: str, **options) -> Build:
    """Imports an adapter when it is built."""

    def build(scene: BenchmarkScene, num_threads: int, device: str) -> Method:
        adapter = getattr(import_module(f".{module}", __package__), name)
        return partial(adapter, **options)(scene, num_threads, device)

    return build


NOT_COMPARED = {"Genesis": "no adapter; its LiDAR sensor needs some 35 further packages, among them a renderer and VTK"}
"""Baselines that are known and not compared, and why."""

ANY = ("cpu", "cuda")
BATCH_RAY, EMBREE, ONE_MESH = "mujoco.batch Batch.ray", "Embree (embreex)", "paper's scheme"
MUJOCO_LIDAR, NEWTON, OPEN3D = "mujoco-lidar", "Newton intersect_ray", "Open3D"


def _mujoco_lidar(name: str, adapter: str, *modules: str, package: str = MUJOCO_LIDAR, **options) -> Entry:
    """A backend of mujoco-lidar, which takes the same rays for all environments."""
    build = _later("mujoco_lidar", adapter, **({"tree": False} if name == "warp" else {}))
    return Entry(f"{MUJOCO_LIDAR} {name}", build, ("mujoco_lidar", *modules), package, shared_scan=True, **options)


BASELINES = (
    Entry(BATCH_RAY, _later("mujoco_native", "BatchRay"), ("mujoco",), "mujoco-core", own_threads=True),
    _mujoco_lidar("warp tree", "WarpBackend", devices=ANY),
    _mujoco_lidar("warp", "WarpBackend", devices=ANY),
    _mujoco_lidar("cpu", "CpuBackend"),
    _mujoco_lidar("taichi", "TaichiBackend", "taichi", "tibvh", package="mujoco-lidar[taichi]", own_threads=True),
    _mujoco_lidar("jax", "JaxBackend", "jax", package="mujoco-lidar jax", own_threads=True),
    Entry(NEWTON, _later("warp_worlds", "Newton"), ("newton",), "newton", devices=ANY),
    Entry("mujoco_warp rays", _later("warp_worlds", "MujocoWarp"), ("mujoco_warp",), "mujoco-warp", devices=ANY),
    Entry(ONE_MESH, _later("one_mesh", "OneMesh"), devices=ANY),
    Entry(EMBREE, _later("embree", "Embree"), ("embreex",), "embreex"),
    Entry(OPEN3D, _later("embree", "Open3D"), ("open3d",), "open3d", own_threads=True),
)
