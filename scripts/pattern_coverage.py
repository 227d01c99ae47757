"""Livox models against the makers' tables, and what fewer rays see."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.pattern_coverage import command

if __name__ == "__main__":
    command()
