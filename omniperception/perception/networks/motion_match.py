"""Scores of candidate velocities for the hit in each sector: where it would have been at each older frame, against the
hits of that frame. A cost volume around the azimuth, as in stereo and optical flow."""

from __future__ import annotations

import math

import torch

from omniperception.common.checked import AtLeastOne, Positive, Positives, checked
from omniperception.common.sectors import FAR


@checked("perception.network.rings.match")
class MotionMatch:
    """Candidate velocities and the width of a match.

    Attributes:
        speeds: m/s; standing still is a candidate besides.
        num_directions: candidates of each speed, equally spaced around the line of sight.
        width: difference of distances at which the score falls to 0, metres.
        period_s: time between two frames, seconds.
    """

    speeds: Positives
    num_directions: AtLeastOne
    width: Positive
    period_s: Positive

    @property
    def num_velocities(self) -> int:
        """K, standing still included."""
        return 1 + len(self.speeds) * self.num_directions

    def velocities(self) -> torch.Tensor:
        """(K, 2) m/s away from the robot and counter-clockwise around it: standing still, then speed by speed."""
        index = torch.arange(self.num_directions, dtype=torch.float32)
        turn = index * (2 * math.pi / self.num_directions)
        ring = torch.stack((turn.cos(), turn.sin()), -1)
        return torch.cat((ring.new_zeros(1, 2), *(speed * ring for speed in self.speeds)))

    def __call__(
        self,
        distance: torch.Tensor,
        bearing: torch.Tensor,
        velocities: torch.Tensor,
        ages: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Scores of all candidates, in operations that can be exported.

        Args:
            distance: (n, H, S) nearest hit of each sector, metres, FAR without one; oldest frame first, all frames
                from the pose of the newest.
            bearing: (n, S) azimuth of the newest frame's hits from the middle of their sectors, radians.
            velocities: (K, 2), those of :meth:`velocities`.
            ages: (n, H - 1) s by which each frame is older than the newest; None: a period for each.

        Returns:
            (n, (H - 1) * K, S): 1 where a frame has a hit at the distance that the velocity predicts, falling linearly
            to 0 at ``width`` from it; 0 in sectors that are empty now.
        """
        history, sectors = distance.shape[1:]
        now = distance[:, -1]
        here = torch.stack((now * bearing.cos(), now * bearing.sin()), 1)[:, :, None]  # (n, 2, 1, S)
        own = torch.arange(sectors, device=distance.device)
        scores = []
        for k in range(history - 1):
            age = self.period_s * (history - 1 - k) if ages is None else ages[:, k, None, None, None]
            x, y = (here - age * velocities.T[None, :, :, None]).unbind(1)  # (n, K, S)
            beside = (torch.atan2(y, x) * (sectors / (2 * math.pi))).round().long()
            there = distance[:, k].gather(1, ((own + beside) % sectors).flatten(1)).view_as(x)
            off = (there - (x * x + y * y).sqrt()).abs() / self.width
            scores.append((1.0 - off).clamp(min=0.0) * (now < FAR)[:, None])
        return torch.cat(scores, 1)
