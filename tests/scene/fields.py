"""Obstacles of many environments, without physics."""

import torch

from omniperception.common.random import EnvRandom
from omniperception.scene import ObstacleField, ObstaclesConfig


def make_field(config: ObstaclesConfig, num_envs: int, seed: int = 0) -> ObstacleField:
    """Obstacles whose poses are in memory of their own; they have not been reset."""
    pos, quat = (torch.zeros(num_envs, len(config.parts()), n, dtype=torch.float64) for n in (3, 4))
    return ObstacleField(config, pos, quat, EnvRandom(seed, num_envs))
