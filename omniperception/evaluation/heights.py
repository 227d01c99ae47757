"""Errors of perceived heights around the robot, against predictors that see nothing."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch

from omniperception.env.config import HEIGHT_TARGET
from omniperception.env.env import OmniEnv
from omniperception.env.heights import height_grid
from omniperception.evaluation.episodes import Policy
from omniperception.learning.models import PerceptionActor


@dataclass(frozen=True)
class HeightErrors:
    """Root mean squared errors (m) over all frames and points of the height grid.

    Attributes:
        rmse: by predictor.
        half_width: half of the 95 % interval of each, from how environments differ.
        by_distance: by predictor, at points nearer than 0.3 m, 0.6 m and beyond.
        frames: frames that were looked at.
    """

    rmse: dict[str, float]
    half_width: dict[str, float]
    by_distance: dict[str, tuple[float, ...]]
    frames: int


RINGS = (0.3, 0.6, math.inf)
"""Horizontal distances (m) from the base that `HeightErrors.by_distance` is split at."""


@torch.inference_mode()
def height_errors(env: OmniEnv, policy: Policy, actor: PerceptionActor, steps: int) -> HeightErrors:
    """Lets the policy walk and compares heights at each new frame.

    The constant predictor says at every point of the grid the mean that is found there in these very frames, so no
    constant does better; "flat ground" says the mean of each frame at all its points, as one who knew no more than the
    height of the base.

    Args:
        env: terrain and obstacles that training has not seen.
        policy: what walks.
        actor: whose perception is asked; its embedding must hold the heights.
        steps: control steps.

    Raises:
        ValueError: the network sets nothing aside for heights, or the environment does not measure them.
    """
    if HEIGHT_TARGET not in actor.perception.supervised or HEIGHT_TARGET not in env.get_observations():
        raise ValueError(
            "this policy's perception says nothing about heights; it needs perception.height_weight above 0 in training"
        )
    part = actor.perception.supervised[HEIGHT_TARGET]
    sensing = env.sensing
    assert sensing is not None  # the perception looks at points
    squared, targets, weights = [], [], []
    tick = -1
    for _ in range(steps):
        obs = env.get_observations()
        actions = policy(obs)
        if sensing.tick != tick:
            tick = sensing.tick
            seen = (obs["frame_count"] > 0).squeeze(-1)
            predicted = actor.embed_newest(obs)[:, part]
            squared.append((predicted - obs[HEIGHT_TARGET]).square() * seen[:, None])
            targets.append(obs[HEIGHT_TARGET].clone())
            weights.append(seen.float())
        env.step(actions)
    target, seen = torch.stack(targets), torch.stack(weights)[..., None]  # (T, N, 187), (T, N, 1)
    mean = (target * seen).sum((0, 1)) / seen.sum()
    flat = target.mean(-1, keepdim=True)
    errors = {
        "perception": torch.stack(squared),
        "constant": (target - mean).square() * seen,
        "flat ground": (target - flat).square() * seen,
    }
    return _summary(errors, seen)


def _summary(errors: dict[str, torch.Tensor], seen: torch.Tensor) -> HeightErrors:
    distance = height_grid(seen.device).norm(dim=1)
    edges = (0.0, *RINGS)
    rings = [(distance >= low) & (distance < high) for low, high in itertools.pairwise(edges)]
    frames = seen.sum(0)
    saw = frames[:, 0] > 0
    rmse, half_width, by_distance = {}, {}, {}
    for name, squared in errors.items():
        mse = float(squared.mean(-1, keepdim=True).sum() / seen.sum())
        per_env = (squared.mean(-1, keepdim=True).sum(0)[saw] / frames[saw]).flatten()
        spread = 1.96 * float(per_env.std() / math.sqrt(len(per_env)))
        rmse[name] = math.sqrt(mse)
        half_width[name] = spread / (2 * rmse[name]) if rmse[name] else 0.0  # of a square root
        by_distance[name] = tuple(math.sqrt(float(squared[..., r].mean(-1).sum() / seen.sum())) for r in rings)
    return HeightErrors(rmse, half_width, by_distance, int(seen.sum()))
