"""Errors of perceived heights, by hand."""

import math

import pytest
import torch
from tensordict import TensorDict

from omniperception.env.heights import NUM_HEIGHTS, height_grid
from omniperception.evaluation.heights import height_errors


class Environment:
    """Three robots and a frame at every second step; robot 2 never sees one."""

    def __init__(self):
        self.sensing, self.steps = self, 0
        generator = torch.Generator().manual_seed(0)
        self.heights = 0.3 + 0.1 * torch.randn(5, 3, NUM_HEIGHTS, generator=generator)

    @property
    def tick(self):
        return self.steps // 2

    def get_observations(self):
        count = torch.tensor([[1], [2], [0]])
        return TensorDict({"height_target": self.heights[self.tick], "frame_count": count}, batch_size=[3])

    def step(self, actions):
        self.steps += 1


class Actor:
    """Is wrong by 5 cm everywhere, and by 10 cm beyond 0.6 m."""

    def __init__(self, env, supervised):
        self.perception, self.env, self.supervised = self, env, supervised

    def embed_newest(self, obs):
        far = height_grid().norm(dim=1) >= 0.6
        return torch.cat((torch.zeros(3, 4), obs["height_target"] + torch.where(far, 0.1, -0.05)), 1)


def test_errors_by_hand():
    env = Environment()
    actor = Actor(env, {"height_target": slice(4, 4 + NUM_HEIGHTS)})
    errors = height_errors(env, lambda obs: None, actor, 10)
    assert errors.frames == 2 * 5
    far = float((height_grid().norm(dim=1) >= 0.6).float().mean())
    assert errors.rmse["perception"] == pytest.approx(math.sqrt(far * 0.01 + (1 - far) * 0.0025), rel=1e-4)
    assert errors.by_distance["perception"] == pytest.approx((0.05, 0.05, 0.1), rel=1e-4)
    assert errors.half_width["perception"] == pytest.approx(0.0, abs=1e-6)
    seen = env.heights[:, :2].flatten(0, 1)
    assert errors.rmse["constant"] == pytest.approx(float((seen - seen.mean(0)).square().mean().sqrt()), rel=1e-4)
    flat = (seen - seen.mean(1, keepdim=True)).square().mean().sqrt()
    assert errors.rmse["flat ground"] == pytest.approx(float(flat), rel=1e-4)


def test_perception_without_heights_is_refused():
    env = Environment()
    with pytest.raises(ValueError, match=r"says nothing about heights; it needs perception\.height_weight above 0"):
        height_errors(env, lambda obs: None, Actor(env, {}), 10)
