"""Triangles of what rays can hit and of how a robot looks, for drawing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from omnilidar import HeightField, Shape, ShapeKind, TriangleMesh, geom_shapes
from omniperception.scene import RobotConfig
from omniperception.scene.robot_file import compile_robot

if TYPE_CHECKING:
    import trimesh

HULL_GROUP = 3
"""Geom group in which robots' files keep what collides, by convention of MuJoCo's model collections."""


@dataclass(frozen=True)
class Look:
    """Triangles of one colour on one body.

    Attributes:
        body: name of the body.
        vertices: (V, 3) m, in the body's frame.
        faces: (F, 3).
        colour: (r, g, b), 0 to 255.
    """

    body: str
    vertices: np.ndarray
    faces: np.ndarray
    colour: tuple[int, int, int]


def triangles(shape: Shape, size: tuple[float, ...] | None = None) -> trimesh.Trimesh | None:
    """The surface of a shape in its own frame; None for a plane, which has no end, and for what deforms.

    Args:
        shape: the shape.
        size: in place of its own, in its own order (m).
    """
    import trimesh

    size, kind, asset = tuple(shape.size if size is None else size), shape.kind, shape.asset
    if kind == ShapeKind.BOX:
        return trimesh.creation.box(extents=2.0 * np.array(size[:3]))
    if kind == ShapeKind.SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == ShapeKind.CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=24)
    if kind == ShapeKind.CAPSULE:
        return _centred_capsule(size[0], 2.0 * size[1])
    if kind == ShapeKind.ELLIPSOID:
        ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        ball.apply_scale(size[:3])
        return ball
    if isinstance(asset, TriangleMesh) and kind == ShapeKind.MESH:
        return trimesh.Trimesh(asset.vertices, asset.triangles, process=False)
    if isinstance(asset, HeightField):
        rows, cols = asset.heights.shape
        x, y = np.linspace(-asset.half_x, asset.half_x, cols), np.linspace(-asset.half_y, asset.half_y, rows)
        return grid_surface(x, y, asset.scale * asset.heights)
    return None


def grid_surface(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> trimesh.Trimesh:
    """The surface over a grid: x (C,), y (R,), z (R, C), all in m; a cell is divided from (r, c) to (r + 1, c + 1)."""
    import trimesh

    rows, cols = z.shape
    vertices = np.stack((*np.meshgrid(x, y), z), -1).reshape(-1, 3)
    row, col = (k.ravel() for k in np.meshgrid(np.arange(rows - 1), np.arange(cols - 1), indexing="ij"))
    a = row * cols + col
    faces = np.concatenate((np.stack((a, a + 1, a + cols + 1), 1), np.stack((a, a + cols + 1, a + cols), 1)))
    return trimesh.Trimesh(vertices, faces, process=False)


def _centred_capsule(radius: float, length: float) -> trimesh.Trimesh:
    import trimesh

    mesh = trimesh.creation.capsule(height=length, radius=radius, count=(16, 16))
    mesh.apply_translation(-mesh.bounds.mean(0))
    return mesh


def robot_looks(robot: RobotConfig) -> list[Look]:
    """How the robot looks, body by body: the geoms of its file that are there for looks, or else those that collide."""
    model = compile_robot(robot.spec(), robot.file)
    collides = [bool(model.geom_contype[k] or model.geom_conaffinity[k]) for k in range(model.ngeom)]
    visible = [k for k in range(model.ngeom) if not collides[k] and model.geom_group[k] != HULL_GROUP]
    chosen = visible or [k for k in range(model.ngeom) if collides[k]]
    found = geom_shapes(model, geoms=chosen)
    parts: dict[tuple[str, tuple[int, int, int]], list[trimesh.Trimesh]] = {}
    for k, shape in zip(found.geom_ids, found.shapes, strict=True):
        mesh = triangles(shape)
        if mesh is None:
            continue
        pose = np.eye(4)
        pose[:3, :3] = _matrix(model.geom_quat[k])
        pose[:3, 3] = model.geom_pos[k]
        mesh.apply_transform(pose)
        parts.setdefault((model.body(model.geom_bodyid[k]).name, _colour(model, k)), []).append(mesh)
    looks = []
    for (body, colour), meshes in parts.items():
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        vertices = np.concatenate([np.asarray(mesh.vertices) for mesh in meshes])
        faces = np.concatenate([np.asarray(mesh.faces) + k for mesh, k in zip(meshes, first, strict=False)])
        looks.append(Look(body, vertices, faces, colour))
    return looks


def _colour(model: mujoco.MjModel, geom: int) -> tuple[int, int, int]:
    """The geom's or its material's; MuJoCo's grey, which nobody chose, becomes a dark one that stands out."""
    material = int(model.geom_matid[geom])
    rgb = (model.geom_rgba[geom] if material < 0 else model.mat_rgba[material])[:3]
    if material < 0 and np.allclose(rgb, 0.5):
        return 62, 66, 82
    red, green, blue = (int(255 * x) for x in rgb)
    return red, green, blue


def _matrix(quat: np.ndarray) -> np.ndarray:
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, np.float64))
    return out.reshape(3, 3)
