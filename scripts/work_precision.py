"""Error against run time of the choices that the framework offers."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.work_precision.__main__ import command

if __name__ == "__main__":
    command()
