"""Where the physics of a robot holds and where it breaks."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.stability import command

if __name__ == "__main__":
    command()
