"""What a network makes of its LiDAR frames, beside what is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn import functional

from omniperception.avoidance.sector_motion import decode
from omniperception.avoidance.velocity import SECTOR_TARGET
from omniperception.env.config import HEIGHT_TARGET
from omniperception.env.env import OmniEnv
from omniperception.learning.models import PerceptionActor
from omniperception.learning.read_out import MotionReadOut


@dataclass(frozen=True)
class Perceived:
    """What is perceived or true in one environment; None where nobody says.

    Attributes:
        sectors: (S, 3) distance (m, infinite without an obstacle) and velocity (m/s, yaw-aligned frame), by sector.
        risk: (K,) of the candidate velocities.
        velocity: (2,) V_avoid, or what a navigation policy adds to the command, m/s, yaw-aligned frame.
        heights: (187,) m, base above the ground at `env.heights.height_grid`.
    """

    sectors: np.ndarray | None = None
    risk: np.ndarray | None = None
    velocity: np.ndarray | None = None
    heights: np.ndarray | None = None


@torch.no_grad()
def perceived(actor: nn.Module, observations: TensorDict, command: torch.Tensor, env_id: int = 0) -> Perceived | None:
    """What the network of an actor says of its newest frames; None where it looks at none, or has none yet.

    Args:
        actor: of any kind.
        observations: what it acts on, of all environments.
        command: (num_envs, 3) as the actor is commanded.
        env_id: the environment that is asked for.
    """
    if not isinstance(actor, PerceptionActor) or "frame_count" not in observations:
        return None
    if not int(observations["frame_count"][env_id]):
        return None
    features = actor.embed_newest(observations)[env_id, None]
    embedding = features[:, : actor.perception.feature_dim]
    parts = actor.perception.supervised
    heights = embedding[0, parts[HEIGHT_TARGET]] if HEIGHT_TARGET in actor.supervision else None
    sectors = risk = velocity = None
    if isinstance(actor.read_out, MotionReadOut):
        sectors = decode(actor.read_out.motion(embedding))[0]
        risk = features[0, actor.perception.feature_dim :]
    elif SECTOR_TARGET in actor.supervision:
        sectors = decode(functional.pad(embedding[:, parts[SECTOR_TARGET], None], (0, 2)))[0]  # nothing moves
    if actor.navigation is not None:
        velocity = None if actor.asked is None else (actor.asked - command)[env_id, :2]
    elif actor.read_out is not None:
        velocity = actor.read_out.velocity(features, command[env_id, None, :2])[0]
    return Perceived(_array(sectors), _array(risk), _array(velocity), _array(heights))


@torch.no_grad()
def true(env: OmniEnv) -> Perceived:
    """The same of environment 0 as the simulation has it."""
    avoidance = env.avoidance
    return Perceived(
        true_sectors(env),
        None if avoidance is None or avoidance.risk is None else _array(avoidance.risk[0]),
        None if avoidance is None else _array(avoidance.velocity[0]),
        _array(env.state.heights[0]),
    )


@torch.no_grad()
def true_sectors(env: OmniEnv, env_id: int = 0) -> np.ndarray | None:
    """(S, 3) `Perceived.sectors` as the simulation has them; without motion where V_avoid is the paper's."""
    avoidance = env.avoidance
    if avoidance is not None and avoidance.motion is not None:
        return _array(avoidance.motion[env_id])
    if avoidance is None or avoidance.sector_distance is None:
        return None
    distance = avoidance.sector_distance[env_id, :, None]
    return _array(torch.cat((distance, torch.zeros_like(distance).expand(-1, 2)), 1))


def _array(tensor: torch.Tensor | None) -> np.ndarray | None:
    return None if tensor is None else tensor.detach().float().cpu().numpy()
