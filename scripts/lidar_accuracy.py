"""Ranges of the LiDAR toolkit against mj_ray in float64."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.lidar_accuracy import command

if __name__ == "__main__":
    command()
