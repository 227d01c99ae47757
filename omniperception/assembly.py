"""Puts a run together: environment, networks and runner from the assembled configuration."""

from __future__ import annotations

import random
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from omniperception.config import ConfigError, RunConfig
from omniperception.learning import Runner, distributed, latest_checkpoint
from omniperception.learning.config import runner_config
from omniperception.learning.memory import check_fits
from omniperception.task.env import OmniEnv
from omniperception.task.mirror import Mirror

if TYPE_CHECKING:
    from omniperception.evaluation.episodes import Policy


def build_runner(run: RunConfig, log_dir: Path | None) -> Runner:
    """The environment and everything that learns in it, seeded; each process of several with a seed of its own.

    A setting that only the compiled world can judge, such as a geom's name, is a ConfigError here.

    Args:
        run: the assembled configuration.
        log_dir: where TensorBoard files and checkpoints go; None writes nothing.
    """
    run = replace(run, env=replace(run.env, seed=run.env.seed + distributed.SEED_STRIDE * distributed.rank()))
    seed_everything(run.env.seed)
    try:
        if run.perception is not None:
            check_fits(run.perception, run.ppo, run.env.num_envs, steps_per_frame(run), run.env.sim.torch_device)
        env = OmniEnv(run.env)
        return Runner(env, learning_settings(run, env), str(log_dir) if log_dir else None, str(env.device))
    except (ValueError, ImportError) as error:
        raise ConfigError(str(error)) from error


@dataclass(frozen=True)
class TrainedPolicy:
    """A run's newest policy and the environment to try it in.

    Attributes:
        env: at the start of its first episodes, with all obstacles.
        policy: from observations to actions, without exploration noise.
        checkpoint: where the weights came from.
    """

    env: OmniEnv
    policy: Policy
    checkpoint: Path


def load_policy(run: RunConfig, run_dir: Path) -> TrainedPolicy:
    """The policy of the newest checkpoint in `run_dir`, in the environment of `run`.

    Raises:
        CheckpointError: there is none, or it does not fit.
    """
    checkpoint = latest_checkpoint(run_dir)
    runner = build_runner(replace(run, env=replace(run.env, initial_obstacle_level=1.0)), None)
    runner.load(str(checkpoint), load_cfg={"actor": True})
    return TrainedPolicy(runner.env, runner.get_inference_policy(str(runner.env.device)), checkpoint)


def steps_per_frame(run: RunConfig) -> int:
    """Control steps between two LiDAR frames."""
    return max(1, round(run.env.lidar.sensor.period_s / run.env.sim.control_dt))


def learning_settings(run: RunConfig, env: OmniEnv) -> dict:
    """rsl_rl's configuration for a run in its environment."""
    observations = run.env.observations
    return runner_config(
        run.ppo,
        run.perception,
        observations.actor,
        observations.critic,
        steps_per_frame(run) if run.perception is not None else 1,
        run.env.rewards.avoidance.risk,
        Mirror(env) if run.ppo.symmetry else None,
    )


def seed_everything(seed: int) -> None:
    """Seeds the global generators; the task's own streams come from its configuration."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)
