"""Avoidance velocities from an embedding: regressed directly, or by way of the obstacles around and their motion."""

from __future__ import annotations

import torch
from torch import nn

from omniperception.avoidance.sector_motion import decode, motion_error
from omniperception.avoidance.velocity_risk import VelocityRisk

RISK_WEIGHT = 3.0
"""Weight of the squared error of risks that a network says itself, relative to that of the motion."""


class VelocityReadOut(nn.Module):
    """The avoidance velocity itself, by an MLP on the embedding that starts at zero."""

    def __init__(self, feature_dim: int) -> None:
        """Args: feature_dim: D, size of the embedding."""
        super().__init__()
        self.feature_dim = feature_dim
        self.layers = zero_mlp(feature_dim, 64, 2)

    def extend(self, embedding: torch.Tensor) -> torch.Tensor:
        """Embeddings (..., D) with the avoidance velocity appended: (..., D + 2)."""
        return torch.cat((embedding, self.layers(embedding).float()), -1)

    def velocity(self, features: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
        """(B, 2) avoidance velocity (m/s, yaw-aligned frame).

        Args:
            features: (B, D + 2) from :meth:`extend`, or (B, D) embeddings.
            command: not read.
        """
        if features.shape[1] == self.feature_dim:
            features = self.extend(features)
        return features[:, self.feature_dim :]

    def error(self, features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """(B,) mean squared error against the avoidance velocity (B, 2) that the simulation's obstacles give."""
        return (self.layers(features).float() - target).square().mean(-1)


class MotionReadOut(nn.Module):
    """The nearest obstacle of each azimuth sector and its motion; the avoidance velocity follows from their risk.

    The risks of the candidate velocities are computed once per embedding, the choice among them at every control step.
    """

    candidates: torch.Tensor

    def __init__(
        self,
        feature_dim: int,
        num_values: int,
        part: slice | None,
        velocity_risk: VelocityRisk,
        risk_part: slice | None = None,
    ) -> None:
        """Configure the read-out.

        Args:
            feature_dim: D, size of the embedding.
            num_values: 3 S, numbers of the S sectors.
            part: where in the embedding they are; None: an MLP on the whole embedding gives them.
            velocity_risk: the controller.
            risk_part: where in the embedding the network says the risks of the candidates; None: they follow from the
                sectors.
        """
        super().__init__()
        if risk_part is not None:
            given, directions = risk_part.stop - risk_part.start, num_values // 3
            if velocity_risk.num_directions != directions or velocity_risk.num_candidates != given:
                raise ValueError(
                    f"perception.network.rings.risk_rings={(given - 1) // directions} says risks of as many speeds in"
                    f" {directions} directions, but rewards.avoidance.risk has num_rings={velocity_risk.num_rings}"
                    f" num_directions={velocity_risk.num_directions}; give both the same"
                )
        self.risk_part = risk_part
        self.feature_dim, self.part, self.velocity_risk = feature_dim, part, velocity_risk
        self.layers = zero_mlp(feature_dim, 256, num_values) if part is None else None
        self.register_buffer("candidates", velocity_risk.candidates(), persistent=False)

    def motion(self, embedding: torch.Tensor) -> torch.Tensor:
        """(B, S, 3) sectors as :func:`~omniperception.avoidance.sector_motion.encode` gives them, from (B, D)."""
        values = embedding[:, self.part] if self.layers is None else self.layers(embedding)
        return values.float().unflatten(-1, (-1, 3))

    def extend(self, embedding: torch.Tensor) -> torch.Tensor:
        """Embeddings (..., D) with the risks of the K candidate velocities appended: (..., D + K)."""
        return torch.cat((embedding, self.risks(embedding.flatten(0, -2)).unflatten(0, embedding.shape[:-1])), -1)

    def risks(self, embedding: torch.Tensor) -> torch.Tensor:
        """(B, K) risks of the candidates, from (B, D)."""
        return self._risk(self.motion(embedding)) if self.risk_part is None else embedding[:, self.risk_part].float()

    def velocity(self, features: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
        """(B, 2) avoidance velocity (m/s, yaw-aligned frame).

        Args:
            features: (B, D + K) from :meth:`extend`, or (B, D) embeddings.
            command: (B, 2) commanded velocity, m/s.
        """
        if features.shape[1] == self.feature_dim:
            features = self.extend(features)
        return self.velocity_risk.avoidance(features[:, self.feature_dim :], command, self.candidates)

    def error(self, features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """(B,) squared errors against the true sectors (B, 3 S), and of the risks that follow from them."""
        target = target.unflatten(-1, (-1, 3))
        predicted = self.motion(features)
        with torch.no_grad():
            risk = self._risk(target)
        if self.risk_part is not None:
            weight, said = RISK_WEIGHT, self.risks(features)
        else:
            weight, said = 1.0, self._risk(predicted)
        return motion_error(predicted, target) + weight * (said - risk).square().mean(-1)

    def _risk(self, motion: torch.Tensor) -> torch.Tensor:
        return self.velocity_risk.risk(decode(motion), self.candidates)


def zero_mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """An MLP of one hidden layer whose output is zero until it is trained."""
    last = nn.Linear(hidden, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ELU(), last)
