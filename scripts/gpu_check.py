"""Everything that a GPU has to show."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.gpu_check import command

if __name__ == "__main__":
    command()
