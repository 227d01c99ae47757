"""Starts a policy from the weights of another run, whatever the two perceive."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from rsl_rl.models import MLPModel

from omniperception.learning.checkpoint import CheckpointError
from omniperception.learning.estimator import EstimatingModel

_FIRST_LAYER = "mlp.0.weight"
_OPTIONAL = ("perception.", "read_out.")


def perceive_as(model: MLPModel, weights: Mapping[str, torch.Tensor], source: str) -> None:
    """Copies the perception network of another run, and what reads it out, into a model, whatever the rest observes.

    Args:
        model: whose weights are replaced in place.
        weights: the state of the other.
        source: names the other run in an error.

    Raises:
        CheckpointError: the other run perceives nothing, or otherwise.
    """
    state = model.state_dict()
    perceived = [name for name in state if name.startswith(_OPTIONAL)]
    for name in perceived:
        own, other = state[name], weights.get(name)
        if other is None or other.shape != own.shape:
            raise _misfit(f"init={source} does not give its perception", name, own, other, "perception")
    if not perceived:
        raise CheckpointError(f"init={source} is to give its perception, but this run has none; give one run alone")
    for name in perceived:
        state[name].copy_(weights[name])


def start_from(model: MLPModel, weights: Mapping[str, torch.Tensor], source: str) -> None:
    """Copies the actor's weights of another run into a model with the same one-dimensional observations.

    The first layer reads these observations before an embedding, so a policy that walked blind starts to walk with
    eyes; the columns of the embedding keep their initial values unless the perception network fits too.

    Args:
        model: whose weights are replaced in place.
        weights: the state of the other.
        source: names the other run in an error.

    Raises:
        CheckpointError: observations, hidden layers or actions differ.
    """
    state = model.state_dict()
    optional = {name for name in state if name.startswith(_OPTIONAL)}
    perceives_alike = all(name in weights and weights[name].shape == state[name].shape for name in optional)
    for name in [name for name in state if perceives_alike or name not in optional]:
        own, other = state[name], weights.get(name)
        if name == _FIRST_LAYER and other is not None and len(other) == len(own):
            blind = model.blind_dim if isinstance(model, EstimatingModel) else model.obs_dim
            shared = own.shape[1] if perceives_alike else blind
            if other.shape[1] >= shared:
                own[:, :shared] = other[:, :shared]
                continue
        if other is None or other.shape != own.shape:
            alike = "observations (groups and history) and ppo.hidden_dims"
            raise _misfit(f"init={source} does not fit", name, own, other, alike)
        own.copy_(other)


def _misfit(what: str, name: str, own: torch.Tensor, other: torch.Tensor | None, alike: str) -> CheckpointError:
    """Of a weight that the other run lacks or has in another shape."""
    given = "nothing" if other is None else f"shape {tuple(other.shape)}"
    return CheckpointError(
        f"{what}: this run's {name} has shape {tuple(own.shape)}, that run's {given}; give both the same {alike}"
    )
