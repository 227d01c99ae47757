"""What LiDARs are looked at in: a room with people, rods, a shelf, stones and the robot; or a mesh of one's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import mujoco
import numpy as np
import torch

from omnilidar import HeightField, RayScene, Shape, ShapeKind, TriangleMesh, geom_shapes
from omniperception.scene import RobotConfig
from omniperception.scene.rays import robot_geoms
from omniperception.viewer.options import Room

Vector = tuple[float, float, float]

ROOM = ((-2.6, 4.4), (-2.7, 2.7), 2.6)
"""The room's extent along x and y and its height, metres; the robot stands at the origin and looks along x."""

WALKING_STRIDE = 0.2
"""How far (m) the feet of people who walk about stand before and behind their hips."""


class DemoClass(IntEnum):
    """Class of the surface that a ray has hit."""

    FLOOR = 0
    WALL = 1
    SHELF = 2
    ROD = 3
    PERSON = 4
    STONE = 5
    ROBOT = 6
    MESH = 7


COLOURS: dict[int, str] = {
    DemoClass.FLOOR: "#8c8f94",
    DemoClass.WALL: "#4f79b5",
    DemoClass.SHELF: "#b5793a",
    DemoClass.ROD: "#d81b60",
    DemoClass.PERSON: "#e8a317",
    DemoClass.STONE: "#3f9142",
    DemoClass.ROBOT: "#1d1d29",
    DemoClass.MESH: "#4f79b5",
}
REFLECTIVITY: dict[int, float] = {
    DemoClass.FLOOR: 0.3,
    DemoClass.WALL: 0.8,
    DemoClass.SHELF: 0.5,
    DemoClass.ROD: 0.6,
    DemoClass.PERSON: 0.4,
    DemoClass.STONE: 0.35,
    DemoClass.ROBOT: 0.1,
    DemoClass.MESH: 0.5,
}
"""Reflectivity of matt surfaces; rough values, chosen by eye."""


@dataclass(frozen=True, kw_only=True)
class DemoScene(Room):
    """The room, or a mesh, in a ray scene.

    Attributes:
        top: Its highest point, metres.
        mesh: The mesh; None: it is the room.
        origin: Where the scene's origin is in the mesh's file, metres, (3,) float64.
    """

    top: float
    mesh: TriangleMesh | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))


def demo_scene(robot: RobotConfig, num_threads: int | None = None, walkers: int = 0) -> DemoScene:
    """The room with a robot in its default pose; lengths in metres, the floor at z = 0.

    With ``walkers`` so many people are bodies of their own, at the origin until somebody moves them, and none stands.
    """
    open_side, walls = _room()
    shapes = [*open_side, *walls, *_furniture(), *([] if walkers else _people()), *_stones()]
    removed = tuple(range(len(open_side)))
    return _with_robot(shapes, robot, (0.0, 0.0, 0.0), removed, ROOM, num_threads=num_threads, walkers=walkers)


def mesh_scene(
    robot: RobotConfig,
    mesh: TriangleMesh,
    at: Sequence[float] = (0.0, 0.0, 0.0),
    walkers: int = 0,
    origin: np.ndarray | None = None,
) -> DemoScene:
    """A mesh with a robot in its default pose whose feet stand ``at`` a place of it, metres, z up; see `demo_scene`."""
    corners = mesh.vertices[mesh.triangles].reshape(-1, 3).astype(float)
    low, high = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    shape = Shape(ShapeKind.MESH, asset=mesh, class_id=DemoClass.MESH)
    extent = ((low[0], high[0]), (low[1], high[1]), high[2])
    demo = _with_robot([shape], robot, at, (), extent, mesh, walkers=walkers)
    return demo if origin is None else replace(demo, origin=origin)


def _with_robot(
    shapes: list[Shape],
    robot: RobotConfig,
    at: Sequence[float],
    open_side: tuple[int, ...],
    extent: tuple[tuple[float, float], tuple[float, float], float],
    mesh: TriangleMesh | None = None,
    num_threads: int | None = None,
    walkers: int = 0,
) -> DemoScene:
    model = robot.compiled()
    found = geom_shapes(model, geoms=robot_geoms(model, robot))
    bodies = tuple(dict.fromkeys((*found.body_ids, *range(1, model.nbody))))
    data = robot.posed(model)
    data.qpos[:3] = np.add(at, (0.0, 0.0, robot.base_height))
    mujoco.mj_kinematics(model, data)

    first = len(shapes)
    shapes = shapes + [replace(shape, class_id=DemoClass.ROBOT) for shape in found.shapes]
    own = len(bodies)
    movers = tuple(range(own, own + walkers))
    shapes += [replace(shape, body=body) for body in movers for shape in _person(0.0, 0.0, 0.0, WALKING_STRIDE)]
    scene = RayScene(shapes, num_envs=1, num_bodies=own + walkers, num_threads=num_threads)
    scene.body_pos[:, :own].copy_(torch.from_numpy(data.xpos[list(bodies)]))
    scene.body_quat[:, :own].copy_(torch.from_numpy(data.xquat[list(bodies)]))
    scene.body_pos[:, own:], scene.body_quat[:, own:] = 0.0, scene.body_quat.new_tensor([1.0, 0.0, 0.0, 0.0])
    return DemoScene(
        scene=scene,
        bodies={model.body(k).name: i for i, k in enumerate(bodies)},
        robot=robot,
        robot_geoms={model.geom(k).name: first + i for i, k in enumerate(found.geom_ids)},
        open_side=open_side,
        extent=extent[:2],
        top=extent[2],
        mesh=mesh,
        movers=movers,
        colours=COLOURS,
        reflectivity=REFLECTIVITY,
        names={kind: kind.name.lower() for kind in DemoClass},
    )


def _room() -> tuple[list[Shape], list[Shape]]:
    """The ceiling and the walls towards -x and -y, then the floor and the other walls."""
    (left, right), (back, front), top = ROOM
    middle = ((left + right) / 2.0, (back + front) / 2.0, top / 2.0)
    half = ((right - left) / 2.0, (front - back) / 2.0, top / 2.0)

    def slab(axis: int, at: float, outwards: float, class_id: DemoClass) -> Shape:
        pos, size = list(middle), [h + 0.1 for h in half]
        pos[axis], size[axis] = at + 0.05 * outwards, 0.05
        return Shape(ShapeKind.BOX, tuple(size), pos=(pos[0], pos[1], pos[2]), class_id=class_id)

    wall = DemoClass.WALL
    removed = [slab(2, top, 1.0, wall), slab(0, left, -1.0, wall), slab(1, back, -1.0, wall)]
    return removed, [slab(2, 0.0, -1.0, DemoClass.FLOOR), slab(0, right, 1.0, wall), slab(1, front, 1.0, wall)]


def _furniture() -> list[Shape]:
    """A bench that hangs from the wall without legs, a board above head height, and rods of 6 to 20 mm."""
    shelf, rod = DemoClass.SHELF, DemoClass.ROD
    return [
        Shape(ShapeKind.BOX, (0.9, 0.3, 0.03), pos=(1.4, 2.4, 0.62), class_id=shelf),
        Shape(ShapeKind.BOX, (0.9, 0.18, 0.02), pos=(1.4, 2.52, 1.5), class_id=shelf),
        Shape(ShapeKind.CYLINDER, (0.12, 0.15), pos=(0.9, 2.4, 0.80), class_id=shelf),
        Shape(ShapeKind.ELLIPSOID, (0.22, 0.16, 0.12), pos=(1.8, 2.4, 0.77), class_id=shelf),
        _rod((1.3, 0.9, 0.0), (1.3, 0.9, 1.8), 0.010, rod),
        _rod((1.6, 0.55, 0.0), (1.6, 0.55, 1.8), 0.006, rod),
        _rod((0.9, -1.6, 0.0), (1.7, -1.0, 1.7), 0.010, rod),
        _rod((-1.4, -1.2, 0.45), (-1.4, 1.4, 0.45), 0.008, rod),
        _rod((-1.4, -1.2, 0.0), (-1.4, -1.2, 0.45), 0.008, rod),
        _rod((-1.4, 1.4, 0.0), (-1.4, 1.4, 0.45), 0.008, rod),
    ]


def _people() -> list[Shape]:
    return [*_person(2.6, -0.9, 2.6, 0.30), *_person(-0.9, 2.0, -1.2, 0.18), *_person(3.7, 0.9, -2.9, 0.0)]


def _person(x: float, y: float, yaw: float, stride: float) -> list[Shape]:
    """A walker of 1.75 m who looks along ``yaw`` with feet ``stride`` before and behind the hips."""
    cos, sin = math.cos(yaw), math.sin(yaw)

    def at(ahead: float, aside: float, up: float) -> Vector:
        return (x + ahead * cos - aside * sin, y + ahead * sin + aside * cos, up)

    person = DemoClass.PERSON
    body = [
        Shape(ShapeKind.SPHERE, (0.115,), pos=at(0.02, 0.0, 1.63), class_id=person),
        _between(at(0.0, 0.0, 1.02), at(0.0, 0.0, 1.33), 0.155, person),
    ]
    for side in (1.0, -1.0):
        step = side * stride
        hip, foot = at(0.0, 0.09 * side, 0.90), at(step, 0.10 * side, 0.08)
        shoulder, hand = at(0.0, 0.20 * side, 1.38), at(-0.8 * step, 0.26 * side, 0.82)
        toe = at(step + 0.16, 0.10 * side, 0.05)
        body += [_between(hip, foot, 0.075, person), _between(shoulder, hand, 0.045, person)]
        body.append(_between(foot, toe, 0.05, person))
    return body


def _stones() -> list[Shape]:
    """A rock of triangles, and a patch of rubble as a height field."""
    rng = np.random.default_rng(3)
    rubble = HeightField(rng.random((33, 33)) ** 2, half_x=0.7, half_y=0.5, scale=0.08)
    return [
        Shape(ShapeKind.MESH, pos=(0.7, -2.0, 0.20), class_id=DemoClass.STONE, asset=_rock(rng)),
        Shape(ShapeKind.HEIGHTFIELD, pos=(0.35, 0.78, 0.0), class_id=DemoClass.STONE, asset=rubble),
    ]


def _rock(rng: np.random.Generator, rings: int = 16, sectors: int = 28) -> TriangleMesh:
    """A flattened ball with bumps; rows of triangles around it, closed at both poles."""
    polar, azimuth = np.linspace(0.0, math.pi, rings + 1), np.arange(sectors) * 2.0 * math.pi / sectors
    theta, phi = np.meshgrid(polar, azimuth, indexing="ij")
    waves = [rng.normal(size=3) * k for k in (1.0, 2.0)]
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    bumps = 1.0 + np.sum([0.10 * np.sin(unit @ wave + k) for k, wave in enumerate(waves)], axis=0)
    vertices = (unit * bumps[..., None] * np.array([0.45, 0.38, 0.34])).reshape(-1, 3)
    ring, sector = (a.ravel() for a in np.meshgrid(np.arange(rings), np.arange(sectors), indexing="ij"))
    a, b = ring * sectors + sector, ring * sectors + (sector + 1) % sectors
    triangles = np.concatenate([np.stack([a, a + sectors, b], 1), np.stack([b, a + sectors, b + sectors], 1)])
    return TriangleMesh(vertices, triangles)


def _rod(start: Vector, end: Vector, radius: float, class_id: DemoClass) -> Shape:
    return replace(_between(start, end, radius, class_id), kind=ShapeKind.CYLINDER)


def _between(start: Vector, end: Vector, radius: float, class_id: DemoClass) -> Shape:
    """A capsule around the line between two points."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    x, y, z = along / length
    quat = np.array([1.0 + z, -y, x, 0.0])  # the shortest turn of the z axis into ``along``
    return Shape(
        ShapeKind.CAPSULE,
        (radius, length / 2.0),
        pos=tuple(np.add(start, end) / 2.0),
        quat=tuple(quat / np.linalg.norm(quat)) if z > -1.0 + 1e-9 else (0.0, 1.0, 0.0, 0.0),
        class_id=class_id,
    )
