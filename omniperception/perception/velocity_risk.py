"""Velocity risk: how near and how soon each velocity would lead past an obstacle, and the velocity that follows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class VelocityRisk:
    """Candidate velocities, their risk and the choice between them.

    The candidates lie on rings around standing still, in the yaw-aligned frame. The risk of one, 0 to 1, is the largest
    The candidates lie on rings around standing still, in the yaw-aligned frame. The risk of one, 0 to 1, is the largest
    obstacle's outline and a disc of `robot_radius` if both keep their velocities until then: a velocity obstacle
    (Fiorini and Shiller, 1998) with soft edges. The choice is the mean of the candidates under the weights
    softmax(-(|v - v_cmd|^2 + weight * risk) / temperature).

    Beyond the paper, whose V_avoid sees distances alone; see docs/learning.md for what it brings.

    Attributes:
        max_speed: of the outermost ring (m/s).
        num_rings: equally spaced speeds.
        num_directions: candidates on each ring.
        times: when the gap is looked at (s).
        robot_radius: (m).
        decay: (m).
        time_constant: (s).
        weight: of a risk of 1 against a squared deviation from the command ((m/s)^2).
        temperature: ((m/s)^2) of the choice; small ones take the best candidate alone.
    """

    max_speed: float
    num_rings: int
    num_directions: int
    times: Sequence[float]
    robot_radius: float
    decay: float
    time_constant: float
    weight: float
    temperature: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", tuple(float(time) for time in self.times))
        for name in ("max_speed", "num_rings", "num_directions", "decay", "time_constant", "weight", "temperature"):
            if getattr(self, name) <= 0:
                raise ValueError(f"rewards.avoidance.risk.{name}={getattr(self, name)} must be positive")
        if self.robot_radius < 0:
            raise ValueError(f"rewards.avoidance.risk.robot_radius={self.robot_radius} must not be negative")
        if not self.times or min(self.times) < 0:
            raise ValueError(f"rewards.avoidance.risk.times={list(self.times)} must be times (s) of at least 0")

    @property
    def num_candidates(self) -> int:
        """K, standing still included."""
        return 1 + self.num_rings * self.num_directions

    def candidates(self, device: torch.device | str = "cpu") -> torch.Tensor:
        """(K, 2) m/s in the yaw-aligned frame: standing still, then the rings from the inside, counter-clockwise."""
        speed = self.max_speed * torch.arange(1, self.num_rings + 1, device=device) / self.num_rings
        angle = 2 * math.pi * torch.arange(self.num_directions, device=device) / self.num_directions
        ring = torch.stack((angle.cos(), angle.sin()), -1)
        return torch.cat((ring.new_zeros(1, 2), (speed[:, None, None] * ring).flatten(0, 1)))

    def avoidance(self, risk: torch.Tensor, command: torch.Tensor, candidates: torch.Tensor) -> torch.Tensor:
        """V_avoid: the choice under the risks less the choice without any, so that no risk changes nothing.

        Args:
            risk: (n, K).
            command: (n, 2) commanded velocity (m/s).
            candidates: those of :meth:`candidates`.

        Returns:
            (n, 2) m/s in the yaw-aligned frame.
        """
        deviation = (command[:, None] - candidates).square().sum(-1)
        wary = torch.softmax(-(deviation + self.weight * risk) / self.temperature, 1)
        free = torch.softmax(-deviation / self.temperature, 1)
        return (wary - free) @ candidates
