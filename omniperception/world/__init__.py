"""One description of robot, terrain and obstacles, from which the physics model and the ray scene are built.

What only tiled terrain or a LiDAR needs is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from omniperception.world.build import World, build_world
from omniperception.world.obstacle_field import ObstacleField
from omniperception.world.obstacles import ApproachConfig, FreePathConfig, ObstacleGroup, ObstaclesConfig
from omniperception.world.robot import RobotConfig
from omniperception.world.terrain import TerrainConfig
from omniperception.world.tiled_terrain import TerrainCurriculumConfig, TiledTerrainConfig

if TYPE_CHECKING:
    from omniperception.world.ground import Ground
    from omniperception.world.rays import ray_shapes

_LOADED_WHEN_USED = {"Ground": "ground", "ray_shapes": "rays"}

__all__ = [
    "ApproachConfig",
    "FreePathConfig",
    "Ground",
    "ObstacleField",
    "ObstacleGroup",
    "ObstaclesConfig",
    "RobotConfig",
    "TerrainConfig",
    "TerrainCurriculumConfig",
    "TiledTerrainConfig",
    "World",
    "build_world",
    "ray_shapes",
]


def __getattr__(name: str) -> object:
    if name in _LOADED_WHEN_USED:
        return getattr(import_module(f"{__name__}.{_LOADED_WHEN_USED[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
