"""One description of robot, terrain and obstacles, from which the physics model and the ray scene are built.

What only tiled terrain or a LiDAR needs is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from omniperception.scene.build import World, build_world
from omniperception.scene.obstacle_field import ObstacleField
from omniperception.scene.obstacles import ApproachConfig, FreePathConfig, ObstacleGroup, ObstaclesConfig
from omniperception.scene.robot import Mount, RobotConfig
from omniperception.scene.terrain import TerrainConfig
from omniperception.scene.tiled_terrain import TerrainCurriculumConfig, TiledTerrainConfig

if TYPE_CHECKING:
    from omniperception.scene.ground import Ground
    from omniperception.scene.rays import ray_shapes

_LOADED_WHEN_USED = {"Ground": "ground", "ray_shapes": "rays"}

__all__ = [
    "ApproachConfig",
    "FreePathConfig",
    "Ground",
    "Mount",
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
