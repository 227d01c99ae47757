"""Errors of the heights that a run's perception knows."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.height_error import command

if __name__ == "__main__":
    command()
