"""Turns a compiled environment into the shapes that LiDAR rays can meet."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import mujoco

from omniperception.lidar import Shape, ShapeKind
from omniperception.world.build import World


class HitClass(IntEnum):
    """What a ray has met."""

    TERRAIN = 0
    OBSTACLE = 1
    ROBOT = 2


@dataclass(frozen=True)
class RayShapes:
    """Shapes of one environment and where their moving bodies get their poses.

    Attributes:
        shapes: one shape per geom, in the order of `geom_names`; `shape.body` indexes `bodies`.
        geom_names: name of each shape's geom.
        bodies: MuJoCo body ids of the moving bodies, in the order of the ray scene.
    """

    shapes: tuple[Shape, ...]
    geom_names: tuple[str, ...]
    bodies: tuple[int, ...]

    def indices(self, geom_names: tuple[str, ...]) -> tuple[int, ...]:
        """Positions of the named geoms in `shapes`."""
        missing = set(geom_names) - set(self.geom_names)
        if missing:
            raise ValueError(f"lidar.exclude_geoms names {sorted(missing)}; known: {', '.join(self.geom_names)}")
        return tuple(self.geom_names.index(name) for name in geom_names)


_KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE: ShapeKind.PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE: ShapeKind.SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: ShapeKind.CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: ShapeKind.ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER: ShapeKind.CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX: ShapeKind.BOX,
}
_SIZES = {
    ShapeKind.PLANE: 0,
    ShapeKind.SPHERE: 1,
    ShapeKind.CAPSULE: 2,
    ShapeKind.CYLINDER: 2,
    ShapeKind.ELLIPSOID: 3,
    ShapeKind.BOX: 3,
}


def ray_shapes(world: World) -> RayShapes:
    """Every geom of the environment as an exact shape; bodies that cannot move carry no pose."""
    model = world.model
    obstacles = set(world.obstacles.geom_names())
    bodies = tuple(sorted({int(b) for b in model.geom_bodyid if _moves(model, int(b))}))
    shapes, names = [], []
    for i in range(model.ngeom):
        geom, body = model.geom(i), int(model.geom_bodyid[i])
        kind = _KINDS[mujoco.mjtGeom(int(model.geom_type[i]))]
        if geom.name in obstacles:
            hit_class = HitClass.OBSTACLE
        else:
            hit_class = HitClass.ROBOT if _moves(model, body) else HitClass.TERRAIN
        shapes.append(
            Shape(
                kind=kind,
                size=tuple(float(s) for s in model.geom_size[i][: _SIZES[kind]]),
                body=bodies.index(body) if body in bodies else -1,
                pos=tuple(float(x) for x in model.geom_pos[i]),
                quat=tuple(float(x) for x in model.geom_quat[i]),
                class_id=int(hit_class),
            )
        )
        names.append(geom.name)
    return RayShapes(tuple(shapes), tuple(names), bodies)


def _moves(model: mujoco.MjModel, body: int) -> bool:
    return bool(model.body_mocapid[body] >= 0 or model.body_weldid[body] != 0)
