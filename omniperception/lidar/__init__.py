"""A stand-alone LiDAR toolkit: scan patterns, analytic scenes and noise, for thousands of environments."""

from .noise import DistanceNoise, MaskNoise, Noise
from .patterns import ScanPattern, grid, mid360, select_rows
from .scene import RayHits, RayScene
from .sectors import sector_distances
from .sensor import Lidar, LidarConfig, LidarFrame, quat_from_rpy
from .shapes import Shape, ShapeKind

__all__ = [
    "DistanceNoise",
    "Lidar",
    "LidarConfig",
    "LidarFrame",
    "MaskNoise",
    "Noise",
    "RayHits",
    "RayScene",
    "ScanPattern",
    "Shape",
    "ShapeKind",
    "grid",
    "mid360",
    "quat_from_rpy",
    "sector_distances",
    "select_rows",
]
