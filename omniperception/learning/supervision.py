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

    def __init__(
        self,
        actor: PerceptionActor,
        epochs: int,
        learning_rates: tuple[float, float],
        num_updates: int,
        max_grad_norm: float,
    ) -> None:
        """Configure the trainer.

        Args:
            actor: whose perception learns.
            epochs: passes over a rollout.
            learning_rates: of the first and of the last update, linear between them.
            num_updates: updates after which the last learning rate holds.
            max_grad_norm: bound of a step's gradient.
        """
        self._actor, self._epochs, self._max_grad_norm = actor, epochs, max_grad_norm
        self._parameters = list(actor.perception_parameters())
        self._learning_rates, self._num_updates = learning_rates, num_updates
        self.optimizer = torch.optim.Adam(self._parameters, lr=learning_rates[0])

    def train(self, storage: PerceptiveStorage, update: int, num_mini_batches: int, mixed_precision: bool) -> None:
        """Fits the targets of a full rollout; a rollout without a frame teaches nothing.

        Args:
            storage: the rollout.
            update: number of the update, from 0.
            num_mini_batches: in which an epoch goes through it.
            mixed_precision: whether matrices are multiplied in bfloat16.
        """
        first, last = self._learning_rates
        for group in self.optimizer.param_groups:
            group["lr"] = first + (last - first) * min(update / self._num_updates, 1.0)
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
