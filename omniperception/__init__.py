"""OmniPerception: learn collision avoidance for legged robots from LiDAR point clouds."""

import os

# Physics, rays and PyTorch take turns on the same cores. PyTorch's OpenMP threads spin for milliseconds after work
# by default, which takes a core from the next computation; this is read when PyTorch is loaded.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
