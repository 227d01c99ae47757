"""Run by a test in a fresh process: load checkpoints of the toy runs, train on, save."""

import sys
from pathlib import Path

import torch
from toy_env import ToyEnv, config

from omniperception.learning import Runner, latest_checkpoint

if __name__ == "__main__":
    folder, iterations = Path(sys.argv[1]), int(sys.argv[2])
    torch.set_num_threads(1)  # as in the first process: sums depend on it
    torch.manual_seed(12345)  # whatever the new process starts with must not matter
    for kind in folder.iterdir():
        frames = kind.name != "blind"
        run_dir = kind / "part"
        runner = Runner(ToyEnv(frames=frames, seed=99), config(frames, kind.name == "supervised"), run_dir)
        runner.load(latest_checkpoint(run_dir))
        runner.learn(iterations)
