"""Where physics, LiDAR and learning hold and where they break."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.stability.__main__ import command

if __name__ == "__main__":
    command()
