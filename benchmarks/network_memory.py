"""Memory of perception networks as other rollout storages would need it, and the largest raw cloud that fits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch

from omniperception.learning.config import PerceptionConfig, PPOConfig
from omniperception.learning.memory import FLOAT, Footprint, footprint, kept_for_backward


def footprint_of_windows(
    perception: PerceptionConfig, ppo: PPOConfig, num_envs: int, steps_per_frame: int
) -> Footprint:
    """Memory if every control step's whole window of frames were stored and embedded.

    So does a storage that knows nothing of frames.
    """
    with torch.device("meta"):
        network = perception.build_network()
    steps = ppo.num_steps_per_env
    return replace(
        footprint(perception, ppo, num_envs, steps_per_frame),
        rollout=FLOAT * 3 * network.num_points * num_envs * network.history * steps,
        mini_batch=kept_for_backward(network, -(-num_envs // ppo.num_mini_batches) * steps, 1),
    )


def largest_cloud(
    perception: PerceptionConfig,
    ppo: PPOConfig,
    num_envs: int,
    steps_per_frame: int,
    budget: float,
    by=footprint,
) -> int:
    """Most rays per frame whose raw cloud fits ``budget`` bytes; for a network whose memory is linear in them.

    Args:
        perception: a network on the raw cloud.
        ppo: steps per rollout and mini-batches.
        num_envs: environments.
        steps_per_frame: control steps between two LiDAR frames.
        budget: bytes.
        by: :func:`footprint` or :func:`footprint_of_windows`.
    """

    def total(num_rays: int) -> int:
        sampler = partial(perception.sampler.func, **{**perception.sampler.keywords, "num_rays": num_rays})
        return by(replace(perception, sampler=sampler), ppo, num_envs, steps_per_frame).total

    one, two = total(1000), total(2000)
    return max(0, int(1000 + (budget - one) * 1000 / (two - one)))
