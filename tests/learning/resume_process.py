"""Run by a test in a fresh process: load a checkpoint of the toy run, train on, save."""

import sys

import torch
from toy_env import ToyEnv, config

from omniperception.learning import Runner, latest_checkpoint

if __name__ == "__main__":
    run_dir, iterations, kind = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    torch.set_num_threads(1)  # as in the first process: sums depend on it
    torch.manual_seed(12345)  # whatever the new process starts with must not matter
    settings = config(kind != "blind", kind == "supervised")
    runner = Runner(ToyEnv(frames=kind != "blind", seed=99), settings, run_dir)
    runner.load(str(latest_checkpoint(run_dir)))
    runner.learn(iterations)
