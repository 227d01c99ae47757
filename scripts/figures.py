"""The paper's figures of the method: the framework, and V_avoid by sectors."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.figures import command

if __name__ == "__main__":
    command()
