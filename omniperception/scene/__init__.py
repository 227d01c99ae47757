"""One description of robot, terrain and obstacles, from which the physics model and the ray scene are built.

`scene.ground` and `scene.rays` need Warp, which takes a quarter of a second to import: those who use them import them.
"""

from omniperception.scene.build import World, build_world
from omniperception.scene.map_terrain import MapTerrainConfig
from omniperception.scene.obstacle_field import ObstacleField
from omniperception.scene.obstacle_group import ApproachConfig, MotionConfig, ObstacleGroup
from omniperception.scene.obstacles import FreePathConfig, ObstaclesConfig
from omniperception.scene.parts import PartConfig, SwingConfig
from omniperception.scene.robot import Mount, RobotConfig
from omniperception.scene.stepping import SteppingConfig
from omniperception.scene.terrain import TerrainConfig
from omniperception.scene.tiled_terrain import TerrainCurriculumConfig, TiledTerrainConfig

__all__ = [
    "ApproachConfig",
    "FreePathConfig",
    "MapTerrainConfig",
    "MotionConfig",
    "Mount",
    "ObstacleField",
    "ObstacleGroup",
    "ObstaclesConfig",
    "PartConfig",
    "RobotConfig",
    "SteppingConfig",
    "SwingConfig",
    "TerrainConfig",
    "TerrainCurriculumConfig",
    "TiledTerrainConfig",
    "World",
    "build_world",
]
