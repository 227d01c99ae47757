"""A policy that estimates what it cannot measure: a network is fitted to the truth, and the policy reads its output."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP, HiddenState
from tensordict import TensorDict

from omniperception.env.mdp.observations import true_base_lin_vel
from omniperception.env.mdp.terms import ObservationsConfig


@dataclass(frozen=True)
class EstimatorConfig:
    """Configuration of the estimator.

    Attributes:
        group: observation group with the true values; neither actor nor robot reads it.
        hidden_dims: hidden layers.
    """

    group: str
    hidden_dims: Sequence[int] = (128, 64)


def estimates_velocity(observations: ObservationsConfig) -> bool:
    """Tell whether what a policy estimates is the base's linear velocity, alone and of the present."""
    if observations.estimated is None:
        return False
    group = observations.groups[observations.estimated]
    return list(group.terms.values()) == [true_base_lin_vel] and group.history == 1


class EstimatingModel(MLPModel):
    """An MLP on one-dimensional observation groups and, where asked for, on estimates of what none of them has.

    The estimator reads the same normalised observations, histories and all, and is fitted to the truth by a loss of its
    own (Ji et al. 2022, 'Concurrent training of a control policy and a state estimator'); the policy's loss does not
    reach it.

    Attributes:
        estimator: the network, or None.
        estimate: (N, K) estimates that the newest actions were computed from; None before the first.
        blind_dim: inputs of the policy's first layer that come from no perception: observations and estimates.
        auxiliary_loss: of the newest pass of an update, to be added to what is minimised.
    """

    auxiliary_loss: torch.Tensor | float = 0.0

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        estimator: EstimatorConfig | None = None,
        embedding_dim: int = 0,
        **mlp_options,
    ) -> None:
        """
        Args:
            obs: example observations.
            obs_groups: groups of each observation set.
            obs_set: this model's set.
            output_dim: number of actions.
            estimator: None: nothing is estimated.
            embedding_dim: further inputs of the policy's first layer.
            mlp_options: ``hidden_dims``, ``activation``, ``obs_normalization`` and ``distribution_cfg`` of `MLPModel`.
        """
        num_estimates = 0 if estimator is None else obs[estimator.group].shape[-1]
        self._added_dims = num_estimates, embedding_dim  # read by _get_latent_dim while the base class builds the MLP
        super().__init__(obs, obs_groups, obs_set, output_dim, **mlp_options)
        self.blind_dim = self.obs_dim + num_estimates
        self.estimator: MLP | None = None
        if estimator is not None:
            self.estimator = MLP(self.obs_dim, num_estimates, list(estimator.hidden_dims), "elu")
            self._truth = estimator.group
        self.estimate: torch.Tensor | None = None

    def get_latent(
        self, obs: TensorDict, masks: torch.Tensor | None = None, hidden_state: HiddenState = None
    ) -> torch.Tensor:
        """Normalised one-dimensional groups, then the estimates."""
        latent = super().get_latent(obs, masks, hidden_state)
        if self.estimator is None:
            return latent
        with torch.no_grad():
            estimate = self.estimator(latent)
        if not torch.is_grad_enabled():
            self.estimate = estimate
        return torch.cat((latent, estimate), -1)

    def estimation_error(self, obs: TensorDict) -> torch.Tensor:
        """Mean squared error of the estimates, with gradients for the estimator alone."""
        assert self.estimator is not None  # it is asked for where something is estimated
        with torch.no_grad():
            latent = MLPModel.get_latent(self, obs)
        return (self.estimator(latent) - obs[self._truth]).square().mean()

    def _get_latent_dim(self) -> int:
        return self.obs_dim + sum(self._added_dims)
