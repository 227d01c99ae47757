"""Turns a compiled environment into the shapes that LiDAR rays can meet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

from omniperception.lidar import Shape
from omniperception.lidar.mujoco import geom_shapes
from omniperception.world.build import World
from omniperception.world.terrain import GROUND


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


def ray_shapes(world: World) -> RayShapes:
    """Every geom of the environment as an exact shape; bodies that cannot move carry no pose."""
    model = world.model
    obstacles = set(world.obstacles.geom_names())
    names = tuple(model.geom(k).name for k in range(model.ngeom))
    found = geom_shapes(model, geoms=range(model.ngeom))

    def hit_class(name: str, shape: Shape) -> HitClass:
        if name in obstacles:
            return HitClass.OBSTACLE
        return HitClass.ROBOT if shape.body >= 0 and name != GROUND else HitClass.TERRAIN

    shapes = (
        replace(shape, class_id=int(hit_class(name, shape))) for name, shape in zip(names, found.shapes, strict=True)
    )
    return RayShapes(tuple(shapes), names, found.body_ids)
