"""Rewards of one's own."""

from __future__ import annotations

import torch

from omniperception.env.mdp.terms import StatefulTerm
from omniperception.env.state import EnvState, requires


def mechanical_power(state: EnvState) -> torch.Tensor:
    """sum |tau qdot|, (num_envs,), W."""
    return (state.joint_torque * state.kinematics.joint_vel).abs().sum(1)


@requires("foot_force")
class SoftLanding(StatefulTerm):
    """Vertical force on the feet (N) above `allowed` (N) in the first step of a contact, summed over the feet.

    A class, because it remembers which feet stood in the step before.
    """

    def __init__(self, allowed: float) -> None:
        self.allowed = allowed
        self.stood: torch.Tensor | None = None

    def __call__(self, state: EnvState) -> torch.Tensor:
        """(num_envs,)."""
        force = state.foot_force[..., 2]
        stands = force > 1.0
        lands = stands if self.stood is None else stands & ~self.stood
        self.stood = stands
        return (lands * (force - self.allowed).clamp_min(0.0)).sum(1)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forgets the feet of environments (n,) int64 whose episodes begin."""
        if self.stood is not None:
            self.stood[env_ids] = False
