"""Patterns without moving parts: a depth camera's pixels, a height scanner's parallel rays."""

import math

import numpy as np
import torch

from .table import ScanPattern


def grid(width: int, height: int, fov_deg: float, frames_per_second: float = 30.0) -> ScanPattern:
    """Rays of a pinhole camera that looks along +x, with +y to the left and +z up; one frame is one table.

    Args:
        width: Pixels per row; a ray goes through the centre of each pixel.
        height: Rows, listed from the top, each from left to right; all pixels of a frame are of one instant.
        fov_deg: Horizontal opening angle in degrees, below 180; pixels are square.
        frames_per_second: Rate of whole frames.
    """
    if width < 1 or height < 1:
        raise ValueError(f"grid width={width} and height={height} must be at least 1")
    if not 0.0 < fov_deg < 180.0:
        raise ValueError(f"grid fov_deg={fov_deg} must be between 0 and 180")
    pixel = 2.0 * math.tan(math.radians(fov_deg) / 2.0) / width
    left = (width / 2.0 - 0.5 - np.arange(width)) * pixel
    up = (height / 2.0 - 0.5 - np.arange(height)) * pixel
    up, left = (a.ravel() for a in np.meshgrid(up, left, indexing="ij"))
    return ScanPattern.from_angles(
        np.arctan2(up, np.hypot(1.0, left)),
        np.arctan2(left, 1.0),
        width * height * frames_per_second,
        rows_per_shot=width * height,
    )


def height_scanner(
    size_x: float = 1.6, size_y: float = 1.0, spacing: float = 0.1, frames_per_second: float = 50.0
) -> ScanPattern:
    """Parallel rays along the sensor's -z from a grid of points in its xy plane; one frame is one table.

    The grid is centred on the sensor and includes its edges: (size_x / spacing + 1) x (size_y / spacing + 1) points,
    y running fastest. All rays of a frame are of one instant.

    Args:
        size_x: Length of the grid along x, metres.
        size_y: Length along y, metres.
        spacing: Distance between neighbours, metres.
        frames_per_second: Rate of whole grids.
    """
    if not (spacing > 0.0 and math.isfinite(spacing)):
        raise ValueError(f"lidar.pattern.spacing={spacing} must be a positive length in metres")
    x, y = (_steps(name, size, spacing) for name, size in (("size_x", size_x), ("size_y", size_y)))
    x, y = (a.ravel() for a in np.meshgrid(x, y, indexing="ij"))
    origins = torch.from_numpy(np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float32))
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    return ScanPattern.from_directions(down, len(x) * frames_per_second, origins_s=origins, rows_per_shot=len(x))


def _steps(name: str, size: float, spacing: float) -> np.ndarray:
    steps = size / spacing
    if not steps >= 0.0 or abs(steps - round(steps)) > 1e-6:
        raise ValueError(f"lidar.pattern.{name}={size} must be a multiple of lidar.pattern.spacing={spacing}")
    return (np.arange(round(steps) + 1) - round(steps) / 2.0) * spacing
