"""Speed, error and memory of the LiDAR toolkit beside every baseline that is installed."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.lidar.__main__ import command

if __name__ == "__main__":
    command()
