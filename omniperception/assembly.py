"""Puts a run together: environment, networks and runner from the assembled configuration."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import torch

from omniperception.config import ConfigError, RunConfig
from omniperception.learning import Runner
from omniperception.learning.config import runner_config
from omniperception.task.env import OmniEnv


def build_runner(run: RunConfig, log_dir: Path | None) -> Runner:
    """The environment and everything that learns in it, seeded.

    A setting that only the compiled world can judge, such as a geom's name, is a ConfigError here.

    Args:
        run: the assembled configuration.
        log_dir: where TensorBoard files and checkpoints go; None writes nothing.
    """
    seed_everything(run.env.seed)
    try:
        env = OmniEnv(run.env)
        return Runner(env, learning_settings(run, env), str(log_dir) if log_dir else None, str(env.device))
    except ValueError as error:
        raise ConfigError(str(error)) from error


def learning_settings(run: RunConfig, env: OmniEnv) -> dict:
    """rsl_rl's configuration for a run."""
    observations = run.env.observations
    steps_per_frame = env.sensing.period_steps if env.sensing is not None else 1
    return runner_config(run.ppo, run.perception, observations.actor, observations.critic, steps_per_frame)


def seed_everything(seed: int) -> None:
    """Seeds the global generators; the task's own streams come from its configuration."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)
