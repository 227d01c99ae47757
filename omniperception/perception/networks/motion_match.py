"""How well moving at each of a few velocities explains what is in a sector: where it would then have been at each older
frame, against what was there. A cost volume, as in stereo and optical flow, around the azimuth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import warp as wp

from omniperception.common.launch import launch_over_envs, view

NOTHING = 50.0
"""Distance (m) of an empty sector."""


@dataclass(frozen=True)
class MotionMatch:
    """Velocities to try and what counts as a match.

    Attributes:
        speeds: m/s; standing still is tried besides.
        num_directions: of each speed, equally spaced around the line of sight.
        width: difference of distances (m) from which on nothing matches.
        period_s: time between two frames (s).
    """

    speeds: tuple[float, ...]
    num_directions: int
    width: float
    period_s: float

    def __post_init__(self) -> None:
        for name in ("num_directions", "width", "period_s"):
            if getattr(self, name) <= 0:
                raise ValueError(f"perception.network.rings.match.{name}={getattr(self, name)} must be positive")
        if not self.speeds or min(self.speeds) <= 0:
            raise ValueError(
                f"perception.network.rings.match.speeds={list(self.speeds)} must be at least one, all positive (m/s)"
            )

    @property
    def num_velocities(self) -> int:
        """K, standing still included."""
        return 1 + len(self.speeds) * self.num_directions

    def velocities(self, device: torch.device | str | None = None) -> torch.Tensor:
        """(K, 2) m/s away from the robot and counter-clockwise around it: standing still, then speed by speed."""
        index = torch.arange(self.num_directions, dtype=torch.float32, device=device)
        turn = index * (2 * math.pi / self.num_directions)
        ring = torch.stack((turn.cos(), turn.sin()), -1)
        return torch.cat((ring.new_zeros(1, 2), *(speed * ring for speed in self.speeds)))

    def __call__(self, distance: torch.Tensor, bearing: torch.Tensor, velocities: torch.Tensor) -> torch.Tensor:
        """What moved how, by sector.

        Args:
            distance: (n, H, S) nearest hit of each sector (m, NOTHING without one), oldest frame first, all frames as
                seen from the newest.
            bearing: (n, S) of the newest frame's hits, from the middle of their sectors (rad).
            velocities: those of :meth:`velocities`.

        Returns:
            (n, (H - 1) * K, S): 1 where the frame has a hit just where the velocity says, falling to 0 at `width` from
            there.
        """
        if torch.jit.is_tracing() or torch.onnx.is_in_onnx_export() or distance.is_meta:
            return self._match(distance, bearing, velocities)
        number, history, sectors = distance.shape
        distance, bearing = distance.contiguous(), bearing.contiguous()
        out = distance.new_zeros(number, (history - 1) * self.num_velocities, sectors)
        inputs = [
            view(distance, wp.float32),
            view(bearing, wp.float32),
            view(velocities, wp.vec2),
            self.period_s,
            self.width,
            view(out, wp.float32),
        ]
        launch_over_envs(match_motion, number, inputs, distance.device)
        return out

    def _match(self, distance: torch.Tensor, bearing: torch.Tensor, velocities: torch.Tensor) -> torch.Tensor:
        """As :meth:`__call__`, of operations that can be exported."""
        history, sectors = distance.shape[1:]
        now = distance[:, -1]
        here = torch.stack((now * bearing.cos(), now * bearing.sin()), 1)[:, :, None]  # (n, 2, 1, S)
        own = torch.arange(sectors, device=distance.device)
        scores = []
        for k in range(history - 1):
            age = self.period_s * (history - 1 - k)
            x, y = (here - age * velocities.T[None, :, :, None]).unbind(1)  # (n, K, S)
            beside = (torch.atan2(y, x) * (sectors / (2 * math.pi))).round().long()
            there = distance[:, k].gather(1, ((own + beside) % sectors).flatten(1)).view_as(x)
            off = (there - (x * x + y * y).sqrt()).abs() / self.width
            scores.append((1.0 - off).clamp(min=0.0) * (now < NOTHING)[:, None])
        return torch.cat(scores, 1)


@wp.kernel(module="unique", enable_backward=False)
def match_motion(
    env_offset: int,
    distance: wp.array3d(dtype=wp.float32),
    bearing: wp.array2d(dtype=wp.float32),
    velocities: wp.array(dtype=wp.vec2),
    period: float,
    width: float,
    # out
    scores: wp.array3d(dtype=wp.float32),
):
    """Of one window; see `MotionMatch`."""
    window = wp.tid() + env_offset
    newest = distance.shape[1] - 1
    num_sectors = distance.shape[2]
    for s in range(num_sectors):
        now = distance[window, newest, s]
        if now < wp.static(NOTHING):
            here = now * wp.vec2(wp.cos(bearing[window, s]), wp.sin(bearing[window, s]))
            for k in range(newest):
                age = period * float(newest - k)
                for v in range(velocities.shape[0]):
                    place = here - age * velocities[v]
                    beside = wp.round(wp.atan2(place[1], place[0]) * float(num_sectors) / wp.static(2.0 * math.pi))
                    there = distance[window, k, (s + int(beside) + num_sectors) % num_sectors]
                    off = wp.abs(there - wp.length(place)) / width
                    scores[window, k * velocities.shape[0] + v, s] = wp.max(1.0 - off, 0.0)
