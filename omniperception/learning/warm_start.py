"""Starts a policy from the weights of another run, whatever the two perceive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization

from omniperception.env.mdp.terms import ActorInput
from omniperception.learning.checkpoint import CheckpointError
from omniperception.learning.estimator import EstimatingModel

_FIRST_LAYER, _FIRST_BIAS = "mlp.0.weight", "mlp.0.bias"
_TRUE = "true_"  # how the observation begins that an estimator of another one is fitted to
_PERCEIVED, _NAVIGATION, _LAYERS = ("perception.", "read_out."), "navigation.", "mlp.network."
_OPTIONAL = (*_PERCEIVED, _NAVIGATION)


def take_parts(model: MLPModel, weights: Mapping[str, torch.Tensor], source: str) -> bool:
    """Copies what another run perceives and navigates with into a model that does either, whatever the rest does.

    Args:
        model: whose weights are replaced in place.
        weights: the state of the other.
        source: names the other run in an error.

    Returns:
        Whether the perception was copied.

    Raises:
        CheckpointError: the other run has neither, or in another form.
    """
    given = {name.removeprefix(_NAVIGATION): value for name, value in weights.items()}
    state, copies = model.state_dict(), []
    perceives = all(any(name.startswith(_PERCEIVED) for name in one) for one in (state, weights))
    for name, own in state.items():
        part = name.removeprefix(_NAVIGATION)
        if not (perceives if name.startswith(_PERCEIVED) else part.startswith(_LAYERS) and part in given):
            continue
        other = given.get(part)
        if other is None or other.shape != own.shape:
            raise _misfit(f"init={source} does not fit", name, own, other, "perception and navigation")
        copies.append((own, other))
    if not copies:
        raise CheckpointError(f"init={source} neither perceives nor navigates as this run does; name another run")
    for own, other in copies:
        own.copy_(other)
    return perceives


def start_from(model: MLPModel, weights: Mapping[str, torch.Tensor], source: str, with_perception: bool = True) -> bool:
    """Copies the actor's weights of another run into a model with the same one-dimensional observations.

    The first layer reads these observations before an embedding, so a policy that walked blind starts to walk with
    eyes; the columns of the embedding keep their initial values unless the perception network fits too.

    Args:
        model: whose weights are replaced in place.
        weights: the state of the other.
        source: names the other run in an error.
        with_perception: whether its perception network is copied where it fits.

    Returns:
        Whether the perception network was copied, too.

    Raises:
        CheckpointError: observations, their normalization, hidden layers or actions differ; nothing was copied.
    """
    alike = "observations (groups, history and what is estimated), ppo.hidden_dims and ppo.obs_normalization"
    state, copies = model.state_dict(), []
    optional = [name for name in state if name.startswith(_OPTIONAL)]
    alike_shaped = (name in weights and weights[name].shape == state[name].shape for name in optional)
    fits = with_perception and bool(optional) and all(alike_shaped)
    for name, own in state.items():
        if name in optional and not fits:
            continue
        other = weights.get(name)
        if name == _FIRST_LAYER and other is not None and not fits:
            own = own[:, : model.blind_dim if isinstance(model, EstimatingModel) else model.obs_dim]
            if any(name.startswith("perception.") for name in weights):  # its embedding stays behind
                other = other[:, : own.shape[1]]
        if other is None or other.shape != own.shape:
            raise _misfit(f"init={source} does not fit", name, own, other, alike)
        copies.append((own, other))
    if unknown := [name for name in weights if name not in state and not name.startswith(_OPTIONAL)]:
        raise CheckpointError(
            f"init={source} does not fit: nothing of this run takes that run's {unknown[0]}; give both the same {alike}"
        )
    for own, other in copies:
        own.copy_(other)
    return fits


def estimating(
    model: EstimatingModel,
    weights: Mapping[str, torch.Tensor],
    own: Sequence[ActorInput],
    given: Sequence[ActorInput],
    truth: Sequence[ActorInput],
) -> Mapping[str, torch.Tensor]:
    """The weights of an actor that observes what a model estimates, rearranged for this model.

    The estimate takes over what the measured values of all control steps weighed together: at a steady value, and
    estimated without error, both actors act alike. Actors that differ in anything else are left as they are.

    Args:
        model: that estimates.
        weights: the state of the other actor, which estimates nothing.
        own: inputs of the model.
        given: inputs of the other.
        truth: what is estimated; of `true_<term>` for a term.
    """
    left_out = [column for column, one in enumerate(given) if one not in own]
    column_of = {(one.term.removeprefix(_TRUE), one.component): column for column, one in enumerate(truth)}
    observed = {(one.term, one.component) for one in own}
    if not set(own) < set(given) or observed & column_of.keys():
        return weights
    if any((given[column].term, given[column].component) not in column_of for column in left_out):
        return weights
    kept = [given.index(one) for one in own]
    layer, bias = weights[_FIRST_LAYER], weights[_FIRST_BIAS].clone()
    mean, scale = torch.zeros(len(given)), torch.ones(len(given))
    if isinstance(model.obs_normalizer, EmpiricalNormalization) and "obs_normalizer._mean" in weights:
        mean = weights["obs_normalizer._mean"][0]
        scale = weights["obs_normalizer._std"][0] + model.obs_normalizer.eps
    of_estimates = layer.new_zeros(len(layer), len(truth))
    for column in left_out:
        weight = layer[:, column] / scale[column]
        of_estimates[:, column_of[given[column].term, given[column].component]] += weight
        bias -= weight * mean[column]
    rearranged = dict(weights)
    rearranged[_FIRST_LAYER] = torch.cat((layer[:, kept], of_estimates, layer[:, len(given) :]), 1)
    rearranged[_FIRST_BIAS] = bias
    for name in ("obs_normalizer._mean", "obs_normalizer._var", "obs_normalizer._std"):
        if name in weights:
            rearranged[name] = weights[name][:, kept]
    untrained = {name: value for name, value in model.state_dict().items() if name.startswith("estimator.")}
    return rearranged | untrained


def _misfit(what: str, name: str, own: torch.Tensor, other: torch.Tensor | None, alike: str) -> CheckpointError:
    """Of a weight that the other run lacks or has in another shape."""
    given = "nothing" if other is None else f"shape {tuple(other.shape)}"
    return CheckpointError(
        f"{what}: this run's {name} has shape {tuple(own.shape)}, that run's {given}; give both the same {alike}"
    )
