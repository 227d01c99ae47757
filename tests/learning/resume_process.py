"""Run by a test in a fresh process: load a checkpoint of the toy run, train on, save."""

import sys

import torch
from toy_env import HISTORY, SUPERVISED, ToyEnv, config

from omniperception.learning import Runner, latest_checkpoint

if __name__ == "__main__":
    run_dir, iterations, kind = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    torch.set_num_threads(1)  # as in the first process: sums depend on it
    torch.manual_seed(12345)  # whatever the new process starts with must not matter
    carried = kind.startswith("carried")
    settings = config(kind != "blind", SUPERVISED if kind.endswith("supervised") else None, carried)
    runner = Runner(ToyEnv(frames=kind != "blind", seed=99, history=2 if carried else HISTORY), settings, run_dir)
    runner.load(str(latest_checkpoint(run_dir)))
    runner.learn(iterations)
