"""Running sums of what training reports: reward terms, tracking errors, episode outcomes, anomalies."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from omniperception.common.stateful import Stateful
from omniperception.sim import Failure

OUTCOMES = ("time_out", "fall", "goal", "collision_end", "diverged")
"""Reasons for which an episode can end."""


class EpisodeMetrics(Stateful):
    """Sums on the device, read out at the end of a log interval: a step itself never synchronises with the host.

    Attributes:
        collided: (num_envs,) bool: whether the current episode has had a contact with an obstacle.
    """

    saved = ("_rewards", "_errors", "_outcomes", "_failures", "_clipped", "_healthy_steps", "_steps", "collided")

    def __init__(self, num_envs: int, device: torch.device, reward_terms: tuple[str, ...]) -> None:
        self._names = reward_terms
        self._rewards = torch.zeros(len(reward_terms), device=device)
        self._errors = torch.zeros(5, device=device)
        self._healthy_steps, self._clipped = torch.zeros(2, device=device).unbind(0)
        self._failures = torch.zeros(len(Failure), dtype=torch.int64, device=device)
        self._causes = torch.arange(len(Failure), device=device)
        self._outcomes = torch.zeros(len(OUTCOMES) + 2, device=device)
        self._steps = 0
        self.collided = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def record_rewards(self, weighted: Sequence[torch.Tensor]) -> None:
        """The weighted rewards (num_envs,) of all terms."""
        if weighted:
            self._rewards += torch.stack(tuple(weighted)).mean(1)

    def record_tracking(
        self, lin_error: torch.Tensor, yaw_error: torch.Tensor, healthy: torch.Tensor, calm: torch.Tensor
    ) -> None:
        """Absolute errors (m/s, rad/s) where `healthy`; `calm` marks moments in which a good gait has hardly any: no
        obstacle is near and the command is not new."""
        self._errors[0] += lin_error.mean()
        self._errors[1] += yaw_error.mean()
        self._errors[2] += (lin_error * calm).mean()
        self._errors[3] += calm.float().mean()
        self._healthy_steps += healthy.float().mean()
        self._steps += 1

    def reset(self, env_ids: torch.Tensor) -> None:
        """Begins episodes in environments (n,): what was touched before does not count for them."""
        self.collided.index_fill_(0, env_ids, False)

    def record_clipped(self, clipped: torch.Tensor) -> None:
        """Environments (num_envs,) bool whose action was out of bounds."""
        self._clipped += clipped.sum()

    def record_contacts(self, touching: torch.Tensor) -> None:
        self.collided |= touching
        self._errors[4] += touching.float().mean()

    def record_ends(self, done: torch.Tensor, outcomes: dict[str, torch.Tensor], failure: torch.Tensor) -> None:
        self._outcomes += torch.stack(
            [outcomes[name].sum() for name in OUTCOMES] + [(done & self.collided).sum(), done.sum()]
        )
        self._failures += (failure[:, None] == self._causes).sum(0)

    def calm_velocity_error(self) -> float:
        """Mean linear velocity error (m/s) in calm moments since the last drain; inf if there were none."""
        return float(self._errors[2] / self._errors[3]) if self._errors[3] > 0 else float("inf")

    def _sums(self) -> tuple[torch.Tensor, ...]:
        return self._rewards, self._errors, self._outcomes, self._failures, self._clipped, self._healthy_steps

    def drain(self) -> dict[str, float]:
        """Means since the last call, and clears them."""
        steps = max(self._steps, 1)
        rewards, errors, outcomes = (x.tolist() for x in (self._rewards / steps, self._errors, self._outcomes))
        healthy_steps = max(float(self._healthy_steps), 1e-6)
        log = {f"Reward/{name}": value for name, value in zip(self._names, rewards, strict=True)}
        log["Metrics/velocity_error"] = errors[0] / healthy_steps
        log["Metrics/yaw_rate_error"] = errors[1] / healthy_steps
        if errors[3] > 0:
            log["Metrics/calm_velocity_error"] = errors[2] / errors[3]
        log["Metrics/contact_share"] = errors[4] / steps
        episodes = outcomes[-1]
        if episodes:
            for name, count in zip(OUTCOMES, outcomes, strict=False):
                if name != "diverged":
                    log[f"Metrics/{name}_rate"] = count / episodes
            log["Metrics/collision_rate"] = outcomes[-2] / episodes
        log["Anomalies/diverged"] = outcomes[OUTCOMES.index("diverged")]
        for cause, count in zip(Failure, self._failures.tolist(), strict=True):
            if cause != Failure.NONE:
                log[f"Anomalies/{cause.name.lower()}"] = count
        log["Anomalies/clipped_actions"] = int(self._clipped)
        for total in self._sums():
            total.zero_()
        self._steps = 0
        return log
