"""Run by a test under torchrun: every process learns the toy run in an environment of its own and saves what it has."""

import sys

import numpy as np
import torch
from toy_env import ToyEnv, config

from omniperception.learning import Runner, distributed, latest_checkpoint, list_checkpoints

if __name__ == "__main__":
    run_dir, iterations, out = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    rank = distributed.rank()
    torch.set_num_threads(1)
    torch.manual_seed(rank)
    np.random.seed(rank)
    env = ToyEnv(seed=rank, period=5 + 6 * rank)  # rank 1 has no frame in the first rollout of 8 steps; neither waits
    env.curriculum_levels = [0.25 + 0.5 * rank] * len(env.curriculum_levels)
    runner = Runner(env, config(supervised=True), run_dir)
    if list_checkpoints(run_dir):
        runner.load(str(latest_checkpoint(run_dir)))
    runner.learn(iterations)
    models = {"actor": runner.alg.actor, "critic": runner.alg.critic}
    ended = {
        "parameters": {n: dict(m.named_parameters()) for n, m in models.items()},
        "buffers": {n: dict(m.named_buffers()) for n, m in models.items()},
        "position": env.position,
        "level": env.curriculum_levels[0],
        "iteration": runner.current_learning_iteration,
    }
    torch.save(ended, f"{out}/{rank}.pt")
    distributed.disconnect()
