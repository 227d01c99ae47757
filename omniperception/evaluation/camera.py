"""A camera that follows a robot and comes nearer, or looks from higher up, where something would hide it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

FreeShare = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""Shares (n,) of the ways from a point (3,) to others (n, 3) that are free; `Renderer.free_share`."""


@dataclass(frozen=True)
class Place:
    """Where a camera would like to be, as seen from the robot.

    Attributes:
        distance: m.
        elevation_deg: above the horizon.
        bearing_deg: counter-clockwise from straight ahead.
        look_ahead: m, how far ahead of the robot it looks.
        turns: whether it turns with the robot; otherwise ahead is +x.
    """

    distance: float
    elevation_deg: float
    bearing_deg: float
    look_ahead: float
    turns: bool = True


CAMERAS = {
    "chase": Place(2.7, 26.0, 180.0, 0.8),
    "top": Place(6.5, 82.0, 180.0, 0.8, turns=False),
    "side": Place(2.6, 14.0, -90.0, 0.2),
}
PIVOT_M = 0.3
"""Height above the ground of the point that the camera keeps in view."""
STEEPEST_DEG, STEPS = 85.0, 7
"""It looks from as high up as needed, up to this, in so many steps."""
ENOUGH, LEAST_SHARE = 0.9, 0.05
"""Share of the way to its place with which it is content, and the least that it goes."""
BESIDE_M, BEFORE_M = 0.25, 0.1
"""Room that the camera has beside it, and before what it would be behind."""
FOLLOW_S, TURN_S, RISE_S, RETREAT_S = 0.25, 0.9, 0.35, 0.8
"""Time constants with which it follows position and heading, changes its elevation, and goes back to its distance."""


class FollowCamera:
    """Stays at its place beside the robot, smoothly, but never behind or inside anything."""

    def __init__(self, dt: float, kind: str = "chase") -> None:
        """
        Args:
            dt: time between two calls of `follow`, s.
            kind: one of `CAMERAS`.
        """
        self._place = CAMERAS[kind]
        constants = FOLLOW_S, TURN_S, RISE_S, RETREAT_S
        self._keep_pos, self._keep_heading, self._keep_elevation, self._keep_share = (
            math.exp(-dt / constant) for constant in constants
        )
        self._pos: torch.Tensor | None = None
        self._elevation, self._share = self._place.elevation_deg, 1.0

    def cut(self) -> None:
        """Starts again at the robot's next pose."""
        self._pos = None

    def follow(
        self, foot_w: torch.Tensor, yaw: torch.Tensor, free_share: FreeShare
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Eye and target (3,) (m) for a robot with heading `yaw` () (rad) over a point `foot_w` (3,) of the ground."""
        heading = torch.stack((yaw.cos(), yaw.sin())) if self._place.turns else foot_w.new_tensor([1.0, 0.0])
        begins = self._pos is None
        if self._pos is None:
            self._pos, self._heading = foot_w, heading
        self._pos = self._keep_pos * self._pos + (1 - self._keep_pos) * foot_w
        self._heading = self._keep_heading * self._heading + (1 - self._keep_heading) * heading
        ahead = self._heading / self._heading.norm().clamp(min=1e-6)
        up = foot_w.new_tensor([0.0, 0.0, PIVOT_M])
        seen, middle = foot_w + up, self._pos + up  # the robot, and what the camera turns around

        wanted = self._free_elevation(seen, middle, ahead, free_share)
        self._elevation = wanted if begins else wanted + self._keep_elevation * (self._elevation - wanted)
        (free,) = self._shares(seen, middle, ahead, [self._elevation], free_share)
        self._share = free if begins else min(free, 1.0 + self._keep_share * (self._share - 1.0))
        end = middle + self._place.distance * self._direction(ahead, self._elevation)
        target = self._pos + torch.cat((self._share * self._place.look_ahead * ahead, ahead.new_tensor([0.2])))
        return seen + self._share * (end - seen), target

    def _free_elevation(
        self, seen: torch.Tensor, middle: torch.Tensor, ahead: torch.Tensor, free_share: FreeShare
    ) -> float:
        """The lowest elevation (deg) at which hardly anything is in the way, or else where most of the way is free."""
        lowest = self._place.elevation_deg
        elevations = [lowest + k * (STEEPEST_DEG - lowest) / (STEPS - 1) for k in range(STEPS)]
        shares = self._shares(seen, middle, ahead, elevations, free_share)
        best = min(ENOUGH, max(shares))
        return next(e for e, share in zip(elevations, shares, strict=True) if share >= best)

    def _shares(
        self,
        seen: torch.Tensor,
        middle: torch.Tensor,
        ahead: torch.Tensor,
        elevations: list[float],
        free_share: FreeShare,
    ) -> list[float]:
        """Shares of the ways from the robot to the camera's place that it can take, by elevation (deg)."""
        ends = []
        for elevation in elevations:
            way = self._direction(ahead, elevation)
            right = torch.linalg.cross(way, way.new_tensor([0.0, 0.0, 1.0]))
            right = right / right.norm()
            up = torch.linalg.cross(right, way)
            sides = torch.stack((0.0 * right, right, -right, up, -up))
            ends.append(middle + self._place.distance * way + BESIDE_M * sides)
        shares = free_share(seen, torch.cat(ends)).unflatten(0, (len(elevations), -1)).amin(1)
        before = BEFORE_M / self._place.distance
        return [1.0 if share >= 1.0 else max(share - before, LEAST_SHARE) for share in shares.tolist()]

    def _direction(self, ahead: torch.Tensor, elevation_deg: float) -> torch.Tensor:
        """(3,) unit vector from the pivot to the camera."""
        bearing, elevation = math.radians(self._place.bearing_deg), math.radians(elevation_deg)
        cos, sin = math.cos(bearing), math.sin(bearing)
        level = torch.stack((cos * ahead[0] - sin * ahead[1], sin * ahead[0] + cos * ahead[1]))
        return torch.cat((math.cos(elevation) * level, ahead.new_tensor([math.sin(elevation)])))
