"""One description of robot, terrain and obstacles, from which the physics model and the ray scene are built."""

from omniperception.world.build import World, build_world
from omniperception.world.ground import Ground
from omniperception.world.obstacle_field import ObstacleField
from omniperception.world.obstacles import ApproachConfig, FreePathConfig, ObstacleGroup, ObstaclesConfig
from omniperception.world.rays import ray_shapes
from omniperception.world.robot import RobotConfig
from omniperception.world.terrain import TerrainConfig
from omniperception.world.tiled_terrain import TerrainCurriculumConfig, TiledTerrainConfig

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
