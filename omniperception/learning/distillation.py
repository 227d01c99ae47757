"""Learning from a teacher that is told what the student has to see (DAgger on actions)."""

from __future__ import annotations

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch.nn import functional

from omniperception.avoidance.velocity import AVOIDANCE_TARGET, COMMAND
from omniperception.common.checked import AtLeastOne, Positive, checked


@checked("distillation")
class DistillationConfig:
    """Configuration of the beginning of a training in which the actor is fitted to a teacher's actions.

    Attributes:
        teacher: run directory of a policy that walks blind.
        iterations: how many. After them PPO learns alone.
        learning_rate: of actor and critic in them.
    """

    teacher: str
    iterations: AtLeastOne
    learning_rate: Positive = 1.0e-3


class Teacher:
    """A blind policy that follows the commanded velocity and the true avoidance velocity together.

    Attributes:
        groups: observation groups that it reads, the target among them.
    """

    def __init__(self, actor: MLPModel) -> None:
        """
        Args:
            actor: reads one-dimensional groups, the command's among them.

        Raises:
            ValueError: it does not.
        """
        if COMMAND not in actor.obs_groups:
            raise ValueError(f"distillation.teacher reads {', '.join(actor.obs_groups)}, but no group '{COMMAND}'")
        self._actor = actor.eval().requires_grad_(False)
        self.groups = (*actor.obs_groups, AVOIDANCE_TARGET)

    @torch.no_grad()
    def actions(self, groups: TensorDict) -> torch.Tensor:
        """(B, num_actions) actions without noise for observation groups of batch size B."""
        groups = groups.clone(recurse=False)
        command, avoidance = groups[COMMAND], groups[AVOIDANCE_TARGET]
        groups[COMMAND] = command + functional.pad(avoidance, (0, command.shape[-1] - avoidance.shape[-1]))
        return self._actor(groups)
