"""Stops training at the first number that is not finite, and says where it comes from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from rsl_rl.algorithms import PPO

from omnirobot.common.errors import UserError

_MAX_LOG_RATIO = math.log(torch.finfo(torch.float32).max)
_LARGEST = math.sqrt(torch.finfo(torch.float32).max)


class TrainingDiverged(UserError, RuntimeError):
    """A loss, gradient or parameter is no longer finite; no step has been taken with it."""


class DivergenceGuard:
    """Checks of an algorithm's gradients before each optimiser step, and of its parameters after each update."""

    def __init__(self, algorithm: PPO) -> None:
        """Args: algorithm: on a :class:`PerceptiveStorage`."""
        self._algorithm, self._update = algorithm, 0
        self._has_gradient: dict[str, bool] = {}

    def start(self, update: int) -> None:
        """Args: update: number of the update that begins, named in messages."""
        self._update = update
        self._has_gradient.clear()

    def check_gradients(self, name: str, parameters: Sequence[torch.nn.Parameter]) -> None:
        """Stop at a gradient that is not finite, before a step with it."""
        finite, largest = _finite_and_largest([p.grad for p in parameters if p.grad is not None])
        if not finite:
            raise TrainingDiverged(
                f"update {self._update}: the gradient of the {name} is not finite"
                f" ({self._diagnosis()}); the weights are those of the last good step"
            )
        self._has_gradient[name] = self._has_gradient.get(name, False) or largest > 0.0

    def check_learning(self, losses: dict[str, float]) -> None:
        """Stop if no step of policy or critic had a gradient: one whose norm overflows is made 0 where it is clipped.

        In the first step nothing is clipped by PPO, so that the actor has one unless all advantages are 0, or it does
        already what a teacher does.
        """
        storage = self._algorithm.storage
        idle = [name for name in ("actor", "critic") if not self._has_gradient.get(name, True)]
        if "actor" in idle and (not bool(storage.advantages.any()) or losses.get("imitation") == 0.0):
            idle.remove("actor")
        if idle:
            raise TrainingDiverged(
                f"update {self._update}: the gradient of the {' and '.join(idle)} overflowed in every step, so that"
                f" nothing was learnt (value loss {losses['value']:.3g}, rewards up to"
                f" {float(storage.rewards.abs().max()):.3g}); scale the rewards down"
            )

    def check_parameters(self) -> None:
        """Stop at a parameter or running statistic that is not finite."""
        for name, model in (("actor", self._algorithm.actor), ("critic", self._algorithm.critic)):
            tensors = [t for t in (*model.parameters(), *model.buffers()) if t.is_floating_point()]
            if not _finite_and_largest(tensors)[0]:
                bad = next(n for n, t in model.state_dict().items() if not torch.isfinite(t).all())
                raise TrainingDiverged(
                    f"update {self._update}: {name} parameter '{bad}' is not finite ({self._diagnosis()})"
                )

    def _diagnosis(self) -> str:
        """Name of the stored quantity that is not finite, or advice if all are."""
        algorithm, storage = self._algorithm, self._algorithm.storage
        rollout: dict[str, torch.Tensor] = {f"observation '{k}'": v for k, v in storage.observations.items()}
        if storage.has_frames:
            rollout["observation 'frames'"] = storage.frames
        rollout |= {name: getattr(storage, name) for name in ("rewards", "actions", "values", "returns", "advantages")}
        for name, tensor in rollout.items():
            bad = int((~torch.isfinite(tensor)).sum())
            if bad:
                return f"{bad} non-finite numbers in the rollout's {name}"
        ratio = self._largest_log_ratio()
        if ratio > _MAX_LOG_RATIO:
            return (
                f"rollout finite, an action became exp({ratio:.3g}) times as likely, smallest standard deviation"
                f" {float(algorithm.actor.output_std.min()):.1e}: lower the learning rate or keep more noise"
            )
        name, value = max(((n, float(t.abs().max())) for n, t in rollout.items()), key=lambda item: item[1])
        if value > _LARGEST:
            return f"the rollout's {name} reach {value:.2g}, whose square overflows"
        return f"rollout finite, learning rate {algorithm.learning_rate:.2e}: lower it, or max_grad_norm"

    def _largest_log_ratio(self) -> float:
        """Largest logarithm of an action's likelihood now over that in the rollout."""
        algorithm, largest = self._algorithm, -math.inf
        if algorithm.storage.step == 0:  # the update is over
            return largest
        with torch.no_grad():
            for batch in algorithm.storage.mini_batch_generator(algorithm.num_mini_batches, 1):
                algorithm.actor(batch.observations, stochastic_output=True)
                now = algorithm.actor.get_output_log_prob(batch.actions)
                largest = max(largest, float((now - batch.old_actions_log_prob.squeeze(-1)).max()))
        return largest


def _finite_and_largest(tensors: list[torch.Tensor]) -> tuple[bool, float]:
    """Tell whether every element is finite, and the largest norm of a tensor, with one host synchronisation.

    Euclidean norms take a twentieth of the time of maximum norms; they may overflow, so a bad one is looked into.
    """
    if not tensors:
        return True, 0.0
    largest = float(torch.stack(torch._foreach_norm(tensors)).detach().amax())
    return math.isfinite(largest) or all(bool(torch.isfinite(tensor).all()) for tensor in tensors), largest
