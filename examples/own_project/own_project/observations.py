"""Observations of one's own that a robot measures, so that a policy with them can be exported."""

from __future__ import annotations

import torch

from omniperception.env.mdp.terms import measured_as
from omniperception.env.state import EnvState, requires


@requires("foot_force")
@measured_as("foot_load")
def foot_load(state: EnvState) -> torch.Tensor:
    """(num_envs, feet) force (N) with which each foot pushes down."""
    return -state.foot_force[..., 2]
