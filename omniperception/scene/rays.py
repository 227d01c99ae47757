"""Turns a compiled environment into the shapes that LiDAR rays can meet."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from omniperception.lidar import Shape
from omniperception.lidar.mujoco import geom_shapes
from omniperception.scene.build import World
from omniperception.scene.reach import FieldOfView, unreachable_geoms
from omniperception.scene.terrain import GROUND


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
        base: position of the robot's base in `bodies`, whether it has a shape or not.
    """

    shapes: tuple[Shape, ...]
    geom_names: tuple[str, ...]
    bodies: tuple[int, ...]
    base: int

    def indices(self, geom_names: Sequence[str]) -> tuple[int, ...]:
        """Positions of the named geoms in `shapes`."""
        return tuple(self.geom_names.index(name) for name in geom_names)


def ray_shapes(world: World, leave_out: Collection[str] = ()) -> RayShapes:
    """The geoms of the environment but those named in `leave_out`, as exact shapes; what cannot move has no pose."""
    model = world.model
    obstacles = set(world.obstacles.geom_names())
    kept = [k for k in range(model.ngeom) if model.geom(k).name not in leave_out]
    names = tuple(model.geom(k).name for k in kept)
    found = geom_shapes(model, geoms=kept)
    bodies = tuple(dict.fromkeys((*found.body_ids, world.base_body)))

    def hit_class(name: str, shape: Shape) -> HitClass:
        if name in obstacles:
            return HitClass.OBSTACLE
        return HitClass.ROBOT if shape.body >= 0 and name != GROUND else HitClass.TERRAIN

    shapes = (
        replace(shape, class_id=int(hit_class(name, shape))) for name, shape in zip(names, found.shapes, strict=True)
    )
    return RayShapes(tuple(shapes), names, bodies, bodies.index(world.base_body))


def hidden_geoms(world: World, exclude: Collection[str], view: FieldOfView) -> dict[str, str]:
    """Geoms of the robot that no ray of a sensor on its base meets, and why: excluded, or out of its reach.

    Raises:
        ValueError: `exclude` names a geom that the robot does not have.
    """
    model = world.model
    known = [model.geom(k).name for k in range(model.ngeom)]
    unknown = sorted(set(exclude) - set(known))
    if unknown:
        raise ValueError(f"robot.mounts: exclude_geoms names {unknown}; known: {', '.join(known)}")
    beyond = unreachable_geoms(model, world.base_body, view)
    hidden = {known[k]: "out of the reach of every ray, however the joints stand" for k in sorted(beyond)}
    return hidden | dict.fromkeys(exclude, "named in its mount's exclude_geoms")
