"""The actor that asks a gait for velocities: a choice without learning, and a learned correction of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from rsl_rl.models import MLPModel
from torch import nn

from omniperception.avoidance.velocity_risk import VelocityRisk


@dataclass(frozen=True)
class NavigationConfig:
    """Configuration of a navigation policy.

    Attributes:
        risk: the controller whose choice it corrects.
        learned: whether there is a correction; without one the choice is all.
    """

    risk: VelocityRisk
    learned: bool = True


class Corrected(nn.Module):
    """The first numbers of its input, as many as it gives, plus a network's correction of them."""

    def __init__(self, network: nn.Module, num_outputs: int) -> None:
        """Args: network: from inputs (n, D) to corrections (n, num_outputs), which begin at 0."""
        super().__init__()
        self.network, self.num_outputs = network, num_outputs
        last = [layer for layer in network.modules() if isinstance(layer, nn.Linear)][-1]
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return inputs[..., : self.num_outputs] + self.network(inputs)


class NavigationActor(MLPModel):
    """Velocities (N, 3) that a gait is asked for, from `avoidance.navigation.navigation_inputs`, which is all that it
    observes."""

    def __init__(self, obs, obs_groups, obs_set: str, output_dim: int, **mlp_options) -> None:
        """Arguments of rsl_rl's `MLPModel`."""
        super().__init__(obs, obs_groups, obs_set, output_dim, **mlp_options)
        if self.obs_normalization:
            raise ValueError("ppo.obs_normalization=true scales the choice that navigation corrects; set it to false")
        self.mlp = Corrected(self.mlp, output_dim)
