"""Trains the perception network on privileged targets alone, beside PPO."""

from __future__ import annotations

import torch
from torch import nn

from omniperception.learning.models import PerceptionActor
from omniperception.learning.storage import PerceptiveStorage


class PerceptionTrainer:
    """A few epochs of regression on the rollout's frames, with an optimiser of its own.

    Each frame is compared with the targets of the first control step that sees it, when they were measured.

    PPO then sees the embedding as a fixed observation. A supervised network learns with far larger steps than the
    trust region of a policy allows, and PPO's epochs need not pass through it.

    Attributes:
        optimizer: of the perception network and of what is read out of it.
    """

    def __init__(self, actor: PerceptionActor, epochs: int, learning_rate: float, max_grad_norm: float) -> None:
        """Args: actor; epochs: passes over a rollout; learning_rate; max_grad_norm: bound of a step's gradient."""
        self._actor, self._epochs, self._max_grad_norm = actor, epochs, max_grad_norm
        self._parameters = list(actor.perception_parameters())
        self.optimizer = torch.optim.Adam(self._parameters, lr=learning_rate)

    def train(self, storage: PerceptiveStorage, num_mini_batches: int, mixed_precision: bool) -> None:
        """Fits the targets of a full rollout; a rollout without a frame teaches nothing."""
        device = torch.device(storage.device)
        for _ in range(self._epochs):
            for env_ids in storage.shuffled_envs(num_mini_batches):
                observations = storage.observations_of(env_ids).at_steps(storage.first_steps)
                if not observations.has_frames:
                    continue
                with torch.autocast(device.type, dtype=torch.bfloat16, enabled=mixed_precision):
                    loss = self._actor.supervised_loss(self._actor.embed(observations), observations)
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self._parameters, self._max_grad_norm)
                self.optimizer.step()
