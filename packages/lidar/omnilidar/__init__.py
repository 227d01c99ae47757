"""A stand-alone LiDAR toolkit: scan patterns, scenes, sensors and noise, for many environments at once.

Figures of devices and noise are loaded at once; what needs PyTorch or Warp is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from .devices import DEVICES, DeviceSpec
from .noise import (
    AngularJitter,
    DistanceNoise,
    Dropout,
    GaussianNoise,
    MaskNoise,
    MixedPixels,
    Noise,
    TabulatedNoise,
    max_deviation,
)

if TYPE_CHECKING:
    from .clouds import PointTable, read_points, read_scans, write_points, write_scans
    from .frame import OUTPUTS, LidarFrame
    from .genesis import GenesisScene
    from .heightfield import HeightField
    from .meshes import TriangleMesh
    from .motion import PoseTrack
    from .mujoco import GeomShapes, MujocoScene, geom_shapes
    from .newton import NewtonScene
    from .patterns.custom import custom
    from .patterns.grid import grid, height_scanner
    from .patterns.livox import LIVOX, avia, hap, horizon, mid40, mid70, mid360, mid360_measured, tele15
    from .patterns.selection import Selection, make_selection
    from .patterns.spinning import airy, hdl32e, hdl64e, os0, os1, os2, ouster, spinning, vlp16, vlp32c, xt16, xt32
    from .patterns.table import ScanPattern
    from .patterns.unitree import unitree_l1, unitree_l2
    from .rotations import quat_from_rpy
    from .scene import RayHits, RayScene
    from .sectors import SectorDistances
    from .sensor import Lidar, LidarConfig, env_slices, ray_bytes
    from .shapes import Shape, ShapeKind

_LOADED_WHEN_USED = {
    "clouds": ("PointTable", "read_points", "read_scans", "write_points", "write_scans"),
    "frame": ("OUTPUTS", "LidarFrame"),
    "genesis": ("GenesisScene",),
    "heightfield": ("HeightField",),
    "meshes": ("TriangleMesh",),
    "motion": ("PoseTrack",),
    "mujoco": ("GeomShapes", "MujocoScene", "geom_shapes"),
    "newton": ("NewtonScene",),
    "patterns.custom": ("custom",),
    "patterns.grid": ("grid", "height_scanner"),
    "patterns.livox": ("LIVOX", "avia", "hap", "horizon", "mid40", "mid70", "mid360", "mid360_measured", "tele15"),
    "patterns.selection": ("Selection", "make_selection"),
    "patterns.spinning": (
        *("airy", "hdl32e", "hdl64e", "os0", "os1", "os2", "ouster", "spinning", "vlp16", "vlp32c", "xt16", "xt32"),
    ),
    "patterns.table": ("ScanPattern",),
    "patterns.unitree": ("unitree_l1", "unitree_l2"),
    "rotations": ("quat_from_rpy",),
    "scene": ("RayHits", "RayScene"),
    "sectors": ("SectorDistances",),
    "sensor": ("Lidar", "LidarConfig", "env_slices", "ray_bytes"),
    "shapes": ("Shape", "ShapeKind"),
}

__all__ = [
    "DEVICES",
    "LIVOX",
    "OUTPUTS",
    "AngularJitter",
    "DeviceSpec",
    "DistanceNoise",
    "Dropout",
    "GaussianNoise",
    "GenesisScene",
    "GeomShapes",
    "HeightField",
    "Lidar",
    "LidarConfig",
    "LidarFrame",
    "MaskNoise",
    "MixedPixels",
    "MujocoScene",
    "NewtonScene",
    "Noise",
    "PointTable",
    "PoseTrack",
    "RayHits",
    "RayScene",
    "ScanPattern",
    "SectorDistances",
    "Selection",
    "Shape",
    "ShapeKind",
    "TabulatedNoise",
    "TriangleMesh",
    "airy",
    "avia",
    "custom",
    "env_slices",
    "geom_shapes",
    "grid",
    "hap",
    "hdl32e",
    "hdl64e",
    "height_scanner",
    "horizon",
    "make_selection",
    "max_deviation",
    "mid40",
    "mid70",
    "mid360",
    "mid360_measured",
    "os0",
    "os1",
    "os2",
    "ouster",
    "quat_from_rpy",
    "ray_bytes",
    "read_points",
    "read_scans",
    "spinning",
    "tele15",
    "unitree_l1",
    "unitree_l2",
    "vlp16",
    "vlp32c",
    "write_points",
    "write_scans",
    "xt16",
    "xt32",
]


def __getattr__(name: str) -> object:
    for module, names in _LOADED_WHEN_USED.items():
        if name in names:
            return getattr(import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
