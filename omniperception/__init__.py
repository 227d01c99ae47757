"""OmniPerception: learn collision avoidance for legged robots from LiDAR point clouds."""

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from omniperception.gym import OmniSingleEnv, OmniVectorEnv

# Physics, rays and PyTorch take turns on the same cores. PyTorch's OpenMP threads spin for milliseconds after work
# by default, which takes a core from the next computation; this is read when PyTorch is loaded.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")


def make(*overrides: str, **options: Any) -> "OmniVectorEnv":
    """A vector of environments for any library that takes Gymnasium's; see `omniperception.gym.make`."""
    from omniperception import gym

    return gym.make(*overrides, **options)


def make_single(*overrides: str) -> "OmniSingleEnv":
    """A single environment; see `omniperception.gym.make_single`."""
    from omniperception import gym

    return gym.make_single(*overrides)
