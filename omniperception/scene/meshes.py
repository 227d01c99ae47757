"""Convex meshes for obstacles: packaged ones, made by code, and files."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from omnilidar.mesh_files import read_mesh, unit_hint


def _prism(corners: np.ndarray) -> np.ndarray:
    """Vertices (2 N, 3) over and under corners (N, 2)."""
    return np.concatenate([np.column_stack((corners, np.full(len(corners), z))) for z in (-1.0, 1.0)])


def _circle(num: int) -> np.ndarray:
    angle = 2 * math.pi * np.arange(num) / num
    return np.column_stack((np.cos(angle), np.sin(angle)))


def rock() -> np.ndarray:
    """A boulder: 40 points on a sphere, each drawn in or out by up to a fifth."""
    rng = np.random.default_rng(7)
    points = rng.normal(size=(40, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * rng.uniform(0.8, 1.2, (40, 1))


def wedge() -> np.ndarray:
    """A block whose top slopes along x, from its full height down to a third of it."""
    corners = [(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
    return np.array([(x, y, -1.0) for x, y in corners] + [(x, y, 1.0 if x < 0 else -1.0 / 3.0) for x, y in corners])


def hexagon() -> np.ndarray:
    """An upright hexagonal prism."""
    return _prism(_circle(6))


def bollard() -> np.ndarray:
    """An octagonal post that is thicker at its foot and has a pointed top."""
    ring = _circle(8)
    levels = ((1.0, -1.0), (0.8, -0.4), (0.7, 0.7))
    return np.concatenate([np.column_stack((r * ring, np.full(8, z))) for r, z in levels] + [[[0.0, 0.0, 1.0]]])


MESHES: dict[str, Callable[[], np.ndarray]] = {"rock": rock, "wedge": wedge, "hexagon": hexagon, "bollard": bollard}
"""Makers of vertices (V, 3) of packaged meshes, by name."""


def check_mesh(file: str) -> None:
    """Raises a ValueError in one line if `file` is neither a packaged mesh nor a file."""
    if file not in MESHES and not any(Path(path).is_file() for path in (file, file.rpartition("#")[0])):
        raise ValueError(f"obstacles: file={file} is neither a packaged mesh ({', '.join(MESHES)}) nor a file")


def own_size(file: str) -> tuple[float, float, float]:
    """Half extents (m) of a mesh as its file has it; warns where they are probably in another unit."""
    half = mesh_points(file)[1]
    if file not in MESHES and (said := unit_hint(file, np.array((np.negative(half), half)), 1.0)):
        warnings.warn(f"obstacles: {said}: an obstacle takes half of each as its size", stacklevel=2)
    return half


@cache
def mesh_points(file: str) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Points of a mesh, whose convex hull is meant.

    Args:
        file: name of a packaged mesh, path of a mesh file (see `read_mesh`), or the path of an MJCF or URDF and, after
            `#`, the name of a mesh in it.

    Returns:
        Vertices (V, 3) that fill the box from -1 to 1, and the half extents (m) of the mesh as it is; packaged ones are
        0.25 m.
    """
    if file in MESHES:
        points, unit = MESHES[file](), 0.25
    elif "#" in file and not Path(file).is_file():
        points, unit = mesh_vertices(*file.rsplit("#", 1)), None
    else:
        vertices, triangles = read_mesh(file)
        points, unit = np.unique(vertices[triangles.flatten()], axis=0), None
    low, high = points.min(0), points.max(0)
    half = (high - low) / 2
    if np.linalg.matrix_rank(points - points.mean(0), tol=1e-6 * half.max()) < 3:
        raise ValueError(f"obstacles: file={file} is flat; a mesh needs a volume")
    x, y, z = half if unit is None else (unit, unit, unit)
    return (points - (low + high) / 2) / half, (float(x), float(y), float(z))


def mesh_vertices(file: str, name: str) -> np.ndarray:
    """(V, 3) m, of a mesh of a thing, in its geom's frame."""
    model = compiled(file)
    names = [model.mesh(k).name for k in range(model.nmesh)]
    if name not in names:
        raise ValueError(f"obstacles: file={file}#{name}: it has meshes {', '.join(names) or 'none'}")
    mesh = names.index(name)
    first = model.mesh_vertadr[mesh]
    return model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(np.float64)


@cache
def compiled(file: str) -> mujoco.MjModel:
    """The model of an MJCF or URDF file."""
    if not Path(file).is_file():
        raise ValueError(f"obstacles: file={file} does not exist (working directory: {Path.cwd()})")
    try:
        return mujoco.MjModel.from_xml_path(file)
    except ValueError as error:
        raise ValueError(f"obstacles: file={file} cannot be read: {' '.join(str(error).split())}") from None
