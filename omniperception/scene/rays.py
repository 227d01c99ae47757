"""Turns a compiled environment into the shapes that LiDAR rays can hit."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import mujoco

from omnilidar import Shape
from omnilidar.mujoco import geom_shapes
from omniperception.scene.build import World
from omniperception.scene.robot import RobotConfig
from omniperception.scene.terrain import GROUND


class HitClass(IntEnum):
    """Class of the surface that a ray has hit."""

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


def robot_geoms(model: mujoco.MjModel, robot: RobotConfig) -> list[int]:
    """Ids of the robot's geoms that rays can hit; `model` is the robot alone or in its world."""
    root = model.body(robot.base).id
    own = [k for k in range(model.ngeom) if model.body_rootid[model.geom_bodyid[k]] == root]
    if robot.ray_groups is not None:
        return [k for k in own if model.geom_group[k] in robot.ray_groups]
    return [k for k in own if model.geom_contype[k] or model.geom_conaffinity[k]]


def ray_shapes(world: World, exclude_geoms: Collection[str] = (), carrier: str | None = None) -> RayShapes:
    """Exact shapes of terrain, obstacles and `robot_geoms` but `exclude_geoms`; what cannot move has no pose.

    Of an obstacle that is a mesh the convex hull is taken, which is what the robot touches.

    Args:
        world: the environment.
        exclude_geoms: geoms that rays pass through.
        carrier: body that is among `bodies` whether it has a shape or not, beside the base.

    Raises:
        ValueError: `exclude_geoms` names a geom that the robot's file does not have.
    """
    model = world.model
    known = [model.geom(k).name for k in range(model.ngeom)]
    exclude_geoms = world.robot.built_geoms(exclude_geoms, known)
    root, seen = world.base_body, set(robot_geoms(model, world.robot))
    unseen = {k for k in range(model.ngeom) if model.body_rootid[model.geom_bodyid[k]] == root} - seen
    kept = [k for k, name in enumerate(known) if name not in exclude_geoms and k not in unseen]
    obstacles = set(world.obstacles.geom_names())
    found = geom_shapes(model, geoms=kept, hulls=[k for k in kept if known[k] in obstacles])
    carriers = (world.base_body,) if carrier is None else (world.base_body, model.body(carrier).id)
    bodies = tuple(dict.fromkeys((*found.body_ids, *carriers)))

    def hit_class(name: str, shape: Shape) -> HitClass:
        if name in obstacles:
            return HitClass.OBSTACLE
        return HitClass.ROBOT if shape.body >= 0 and name != GROUND else HitClass.TERRAIN

    names = tuple(known[k] for k in kept)
    named = zip(names, found.shapes, strict=True)
    shapes = tuple(replace(shape, class_id=int(hit_class(name, shape))) for name, shape in named)
    return RayShapes(shapes, names, bodies, bodies.index(world.base_body))
