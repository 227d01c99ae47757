"""Phases of an update: each learns one thing of a rollout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from rsl_rl.storage import RolloutStorage
from torch import nn
from torch.nn import functional

from omniperception.learning import distributed
from omniperception.learning.storage import PerceptiveStorage, WindowedObservations

if TYPE_CHECKING:
    from omniperception.learning.ppo import PerceptivePpo

FIRST_LEARNING_RATE = 1.0e-5
"""Of an adaptive schedule's first update of a policy that can do something already; rsl_rl's least."""
ESTIMATOR_LEARNING_RATE = 1.0e-3
"""Of the estimator's own optimiser, which passes over each rollout once."""


class Phase:
    """Learns one thing of a rollout.

    Attributes:
        alg: whose models it trains.
        optimizer: steps its parameters; one of its own is saved in checkpoints.
        trained: parameters that its losses reach, by what they are in messages.
        max_grad_norm: to which the gradient of each of them is clipped; None: it is not.
    """

    def __init__(
        self,
        alg: PerceptivePpo,
        trained: Mapping[str, Sequence[nn.Parameter]],
        learning_rate: float | None = None,
        max_grad_norm: float | None = None,
    ) -> None:
        """
        Args:
            alg: whose models it trains.
            trained: parameters, by what they are.
            learning_rate: of an Adam of its own; None: it takes steps with the optimiser of policy and critic.
            max_grad_norm: largest norm of a gradient.
        """
        self.alg, self.trained, self.max_grad_norm = alg, trained, max_grad_norm
        self.optimizer = alg.optimizer
        if learning_rate is not None:
            self.optimizer = torch.optim.Adam([p for part in trained.values() for p in part], lr=learning_rate)

    def update(self, storage: PerceptiveStorage) -> dict[str, float]:
        """Learns from a full rollout; returns mean losses by name, which are logged."""
        raise NotImplementedError

    def step(self, loss: torch.Tensor) -> None:
        """A step down a loss: its gradient is averaged over all processes, clipped, and refused if it is not finite."""
        self.optimizer.zero_grad()
        loss.backward()
        for name, parameters in self.trained.items():
            distributed.average_gradients(parameters)
            if self.max_grad_norm is not None:
                nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
            self.alg.guard.check_gradients(name, parameters)
        self.optimizer.step()


class FitPerception(Phase):
    """Supervision of the perception network and its read-out, a few epochs on the frames of each rollout.

    A supervised network learns with far larger steps than the trust region of a policy allows, and PPO need not pass
    through it: PPO takes the embeddings that were acted on as fixed observations.
    """

    def __init__(self, alg: PerceptivePpo) -> None:
        assert alg.config.perception is not None
        self.config = alg.config.perception
        trained = {"perception network": list(alg.actor.perception_parameters())}
        super().__init__(alg, trained, self.config.learning_rate, alg.max_grad_norm)

    def update(self, storage: PerceptiveStorage) -> dict[str, float]:
        """Fits the supervised targets; a rollout without a frame teaches nothing.

        Each frame is compared with the targets of the first control step of the rollout that sees it: of those when it
        was cast, or, for the frame that a rollout begins with, of up to a frame's period later.
        """
        alg, first, last = self.alg, self.config.learning_rate, self.config.final_learning_rate
        self.optimizer.param_groups[0]["lr"] = alg.annealed(first, last)
        acted_on, storage.acted_on = storage.acted_on, None
        for _ in range(self.config.supervised_epochs):
            for env_ids in storage.shuffled_envs(alg.num_mini_batches):
                obs = storage.observations_of(env_ids, storage.first_steps)
                if distributed.mean(float(obs.has_frames), alg.device) < 1.0:  # all processes take a step, or none
                    continue
                with alg.precision():
                    loss = alg.actor.supervised_loss(alg.actor.embed(obs), obs)
                self.step(loss)
        storage.acted_on = acted_on
        return alg.actor.pop_supervised_losses()


class FitEstimator(Phase):
    """Fits what the actor estimates of its own state to the truth, one epoch, mirror images included."""

    def __init__(self, alg: PerceptivePpo) -> None:
        super().__init__(alg, {"estimator": list(alg.actor.estimator.parameters())}, ESTIMATOR_LEARNING_RATE)

    def update(self, storage: PerceptiveStorage) -> dict[str, float]:
        """The mean squared error."""
        alg, groups, losses = self.alg, storage.observations.flatten(0, 1), []
        for steps in torch.randperm(len(groups), device=alg.device).tensor_split(alg.num_mini_batches):
            obs = groups[steps]
            if alg.symmetry is not None:
                obs, _ = alg.symmetry.data_augmentation_func(alg.symmetry.env, obs, None)
            loss = alg.actor.estimation_error(obs)
            self.step(loss)
            losses.append(loss.detach())
        return {"estimate": torch.stack(losses).mean().item()}


class Normalize(Phase):
    """Moves the running statistics by which policy and critic normalise what they observe."""

    def __init__(self, alg: PerceptivePpo) -> None:
        super().__init__(alg, {})

    def update(self, storage: PerceptiveStorage) -> dict[str, float]:
        """Takes in the observations of a rollout."""
        observed = storage.observations.flatten(0, 1)
        self.alg.actor.update_normalization(observed)
        self.alg.critic.update_normalization(observed)
        return {}


class Distil(Phase):
    """Fits the actor to what a teacher would have done where the actor was, and the critic to the returns."""

    def __init__(self, alg: PerceptivePpo) -> None:
        super().__init__(alg, alg.policy_and_critic(), max_grad_norm=alg.max_grad_norm)

    def update(self, storage: PerceptiveStorage) -> dict[str, float]:
        """Mean squared errors of actions and values."""
        alg, config, losses = self.alg, self.alg.config.distillation, []
        if alg.teacher is None or config is None:
            raise RuntimeError("distillation needs a teacher: learn_from")
        alg.set_learning_rate(config.learning_rate)
        for batch in storage.mini_batch_generator(alg.num_mini_batches, alg.num_learning_epochs):
            obs = batch.observations
            wanted = alg.teacher.actions(obs.groups if isinstance(obs, WindowedObservations) else obs)
            with alg.precision():
                error = functional.mse_loss(alg.actor(obs), wanted)
                value_error = functional.mse_loss(alg.critic(obs), batch.returns)
                loss = error + alg.value_loss_coef * value_error
            self.step(loss + alg.actor.auxiliary_loss)
            losses.append(torch.stack((error.detach(), value_error.detach())))
        imitation, value = torch.stack(losses).mean(0).tolist()
        return {"imitation": imitation, "value": value}


class Ppo(Phase):
    """Proximal policy optimisation (Schulman et al. 2017) as rsl_rl does it, on each sample and its mirror image."""

    critic_alone = False

    def __init__(self, alg: PerceptivePpo) -> None:
        trained = alg.policy_and_critic()
        if self.critic_alone:
            del trained["actor"]
        super().__init__(alg, trained, max_grad_norm=alg.max_grad_norm)

    def update(self, storage: PerceptiveStorage) -> dict[str, float]:
        """Mean losses."""
        alg, losses, adapts = self.alg, [], self.alg.schedule == "adaptive" and not self.critic_alone
        if adapts and alg.is_first_of_pretrained():
            alg.learning_rate = FIRST_LEARNING_RATE  # a larger step leaves the trust region
        alg.set_learning_rate(alg.learning_rate)
        for batch in storage.mini_batch_generator(alg.num_mini_batches, alg.num_learning_epochs):
            num_samples = len(batch.actions)
            if alg.symmetry is not None:
                alg.symmetry.augment_batch(batch, num_samples)
            with alg.precision():
                alg.actor(batch.observations, stochastic_output=True)
                if adapts:
                    self._adapt_learning_rate(batch, num_samples)
                surrogate, value = self._surrogate_loss(batch), self._value_loss(batch)
                entropy = alg.actor.output_entropy[:num_samples].mean()
                loss = alg.value_loss_coef * value
                if not self.critic_alone:
                    loss = surrogate + loss - alg.entropy_coef * entropy + alg.actor.auxiliary_loss
            self.step(loss)
            losses.append(torch.stack((value, surrogate, entropy)).tolist())
        means = [sum(column) / len(losses) for column in zip(*losses, strict=True)]
        return dict(zip(("value", "surrogate", "entropy"), means, strict=True))

    def _surrogate_loss(self, batch: RolloutStorage.Batch) -> torch.Tensor:
        """Clipped, of the actions whose distribution the actor has computed."""
        log_prob, clip = self.alg.actor.get_output_log_prob(batch.actions), self.alg.clip_param
        ratio, advantages = torch.exp(log_prob - batch.old_actions_log_prob.squeeze(-1)), batch.advantages.squeeze(-1)
        return torch.max(-advantages * ratio, -advantages * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()

    def _value_loss(self, batch: RolloutStorage.Batch) -> torch.Tensor:
        """Squared error of the critic, clipped where PPO's configuration says so."""
        values, clip = self.alg.critic(batch.observations), self.alg.clip_param
        error = (values - batch.returns).pow(2)
        if self.alg.use_clipped_value_loss:
            clipped = batch.values + (values - batch.values).clamp(-clip, clip)
            error = torch.max(error, (clipped - batch.returns).pow(2))
        return error.mean()

    @torch.inference_mode()
    def _adapt_learning_rate(self, batch: RolloutStorage.Batch, num_samples: int) -> None:
        """Larger steps where the policy has moved less than half the desired divergence, smaller above twice it."""
        alg = self.alg
        now = tuple(p[:num_samples] for p in alg.actor.output_distribution_params)
        kl = alg.actor.get_kl_divergence(batch.old_distribution_params, now).mean().item()
        kl = distributed.mean(kl, alg.device)
        if kl > 2.0 * alg.desired_kl:
            alg.learning_rate = max(1e-5, alg.learning_rate / 1.5)
        elif 0.0 < kl < alg.desired_kl / 2.0:
            alg.learning_rate = min(1e-2, alg.learning_rate * 1.5)
        alg.set_learning_rate(alg.learning_rate)


class WarmCritic(Ppo):
    """The critic's part of PPO alone, in steps that stay as they are, for a policy that can do something already."""

    critic_alone = True
