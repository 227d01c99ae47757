"""Trainings of degenerate scenes and sizes go on, with weights that are finite."""

from dataclasses import replace

import pytest
import torch

from omniperception import build, config

BASE = (
    *("experiment=quickstart", "num_envs=8", "ppo.num_steps_per_env=6", "ppo.mixed_precision=false"),
    *("obstacles.curriculum=null", "sim.num_threads=1"),
)
CASES = {
    "empty clouds": ("lidar.min_range=5.99",),
    "one ray a frame": ("lidar.num_rays=1",),
    "fewer points than sampled": ("lidar.num_rays=20",),
    "every point masked to 0 m": tuple(f"randomization.lidar_mask.{k}" for k in ("ratio=1.0", "low=0.0", "high=0.0")),
    "episodes of one step": ("terminations.episode_length_s=0.02",),
    "mini-batches of one environment": ("ppo.num_mini_batches=8",),
    "rollouts of one step": ("ppo.num_steps_per_env=1", "ppo.num_mini_batches=8"),
    "one environment": ("num_envs=1", "ppo.num_mini_batches=1"),
}


@pytest.mark.slow
@pytest.mark.parametrize("reward", [1.0, 1e6])
@pytest.mark.parametrize("case", CASES)
def test_training_survives(case, reward):
    run = build.assemble(config.compose([*BASE, *CASES[case]]))
    runner = build.build_runner(replace(run, env=replace(run.env, skip_curricula=True)), None)
    step = runner.env.step

    def rewarded(actions):
        observations, rewards, *others = step(actions)
        return observations, reward * rewards, *others

    runner.env.step = rewarded
    runner.learn(1)
    for model in (runner.alg.actor, runner.alg.critic):
        assert all(torch.isfinite(parameter).all() for parameter in model.parameters())
