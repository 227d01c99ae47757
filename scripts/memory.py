"""Memory of a run by part: predicted, and used."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.memory import command

if __name__ == "__main__":
    command()
