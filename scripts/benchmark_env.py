"""Rates of env.step, PPO iterations and updates beside bare physics or another task; latency of exported policies."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.env import command

if __name__ == "__main__":
    command()
