"""Policies that ask a gait for velocities: a choice without learning, and a learned correction of it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from rsl_rl.modules import MLP
from tensordict import TensorDict
from torch import nn

from omniperception.avoidance.navigation import NEARNESS, navigation_inputs, num_inputs
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.common.checked import Pair, Positive, Widths, checked
from omniperception.learning.estimator import EstimatingModel

MOTION, ASKED = "motion", "asked"
"""Groups of observations: the robot's own velocity, and what its gait is asked for, (n, 3) each."""


class VelocityInput(NamedTuple):
    """Where a component of the robot's own velocity is observed.

    Attributes:
        group: of observations.
        column: in the group.
        scale: that the observation is multiplied by.
    """

    group: str
    column: int
    scale: float


@checked("navigation")
class NavigationConfig:
    """Configuration of a navigation policy.

    Attributes:
        risk: the controller whose choice it corrects.
        ranges: (low, high) of v_x, v_y (m/s) and yaw rate (rad/s) that a gait is asked for.
        hidden_dims: hidden layers of the correction.
        turn_acceleration: most (rad/s^2) by which the yaw rate that a gait is asked for changes.
    """

    risk: VelocityRisk
    ranges: tuple[Pair, Pair, Pair]
    hidden_dims: Widths = (128, 128, 64)
    turn_acceleration: Positive = 8.0


class CorrectedChoice(nn.Module):
    """The choice without learning, with which its inputs begin, plus a network's correction, which begins at 0.

    The correction fades out between half of NEARNESS_RANGE and all of it from the nearest obstacle: where nothing is
    near, a command is followed as it is.
    """

    def __init__(self, config: NavigationConfig) -> None:
        super().__init__()
        self.network = MLP(num_inputs(config.risk), 3, list(config.hidden_dims), "elu")
        last = [layer for layer in self.network.modules() if isinstance(layer, nn.Linear)][-1]
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """(n, 3) velocities from `navigation_inputs` (n, D)."""
        nearest = inputs[:, NEARNESS].amax(1, keepdim=True)
        return inputs[:, :3] + (2.0 * nearest).clamp(max=1.0) * self.network(inputs)


class NavigationActor(EstimatingModel):
    """Velocities (N, 3) that a gait is asked for, from `avoidance.navigation.navigation_inputs`, which is all that it
    observes."""

    def __init__(self, obs: TensorDict, *args, navigation: NavigationConfig, **mlp_options) -> None:
        """Args: navigation: settings; the others as rsl_rl's `MLPModel` takes them."""
        super().__init__(obs, *args, **mlp_options)
        if self.obs_normalization:
            raise ValueError("ppo.obs_normalization=true scales the choice that navigation corrects; set it to false")
        expected = num_inputs(navigation.risk)
        if self.obs_dim != expected:
            raise ValueError(
                f"a navigation policy reads the {expected} numbers of NavigationView alone, and observes {self.obs_dim}"
                f" ({', '.join(self.obs_groups)}); use observations=navigate"
            )
        self.mlp = CorrectedChoice(navigation)


class Navigator(nn.Module):
    """A navigation policy behind a perception network: velocities from sectors."""

    candidates: torch.Tensor
    least: torch.Tensor
    most: torch.Tensor

    def __init__(self, config: NavigationConfig) -> None:
        super().__init__()
        for name, values in zip(("least", "most"), zip(*config.ranges, strict=True), strict=True):
            self.register_buffer(name, torch.tensor(values), persistent=False)
        self.risk = config.risk
        self.mlp = CorrectedChoice(config)
        self.register_buffer("candidates", config.risk.candidates(), persistent=False)

    def inputs(
        self,
        sectors: torch.Tensor,
        reference: torch.Tensor,
        velocity: torch.Tensor,
        asked: torch.Tensor,
        risks: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """`navigation_inputs` (n, D)."""
        return navigation_inputs(sectors, reference, velocity, asked, self.risk, self.candidates, risks)

    def forward(self, *given: torch.Tensor | None) -> torch.Tensor:
        """(n, 3) what a gait is to be asked for; arguments as `inputs` takes them."""
        wanted = self.mlp(self.inputs(*given))  # type: ignore[arg-type]
        return torch.minimum(torch.maximum(wanted, self.least), self.most)
