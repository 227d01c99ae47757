"""A camera that follows a robot and comes nearer, or looks from higher up, where something would hide it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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
    "top": Place(5.0, 82.0, 180.0, 0.8, turns=False),
    "side": Place(2.6, 14.0, -90.0, 0.2),
}
PIVOT_M, LOW_M = 0.3, 0.1
"""Heights above the ground of the point that the camera never loses, and of what it sees of the legs where it can."""
STEEPEST_DEG, STEPS = 85.0, 7
"""It looks from as high up as needed, up to this, in so many steps."""
ENOUGH, LEAST_SHARE = 0.9, 0.05
"""Share of the way to its place with which it is content, and the least that it goes."""
BESIDE_M, NEARER_M, HIGHER_M = 0.1, 0.5, 0.75
"""Room that the camera always has beside it; room with less than which it begins to come nearer, and to rise."""
BEFORE_M = 0.1
"""Room that it has before what it would be behind."""
FOLLOW_S, TURN_S, RISE_S, APPROACH_S, RETREAT_S = 0.25, 1.2, 0.5, 0.2, 0.8
"""Time constants with which it follows position and heading, changes its elevation, comes nearer and goes back."""


class FollowCamera:
    """Stays at its place beside the robot, smoothly, but never behind or inside anything."""

    def __init__(self, dt: float, kind: str = "chase") -> None:
        """
        Args:
            dt: time between two calls of `follow`, s.
            kind: one of `CAMERAS`.
        """
        self._place = CAMERAS[kind]
        constants = FOLLOW_S, TURN_S, RISE_S, APPROACH_S, RETREAT_S
        self._keep_pos, self._keep_heading, self._keep_elevation, self._keep_far, self._keep_near = (
            math.exp(-dt / constant) for constant in constants
        )
        self._pos: torch.Tensor | None = None
        lowest = self._place.elevation_deg
        self._elevations = [lowest + k * (STEEPEST_DEG - lowest) / (STEPS - 1) for k in range(STEPS)]
        self._elevation, self._share = lowest, 1.0

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
        up = foot_w.new_tensor([0.0, 0.0, 1.0])
        seen, legs, middle = foot_w + PIVOT_M * up, foot_w + LOW_M * up, self._pos + PIVOT_M * up

        def shares(start: torch.Tensor, elevations: Sequence[float], beside: float) -> list[float]:
            """Free shares of the ways from `start` to the camera's place and points beside it, by elevation (deg)."""
            ends = torch.cat([middle + self._around(ahead, elevation, beside) for elevation in elevations])
            found = free_share(start, ends).unflatten(0, (len(elevations), -1)).amin(1)
            before = torch.where(found < 1.0, BEFORE_M / self._place.distance, 0.0)
            return (found - before).clamp(min=LEAST_SHARE).tolist()

        wanted = self._wanted_elevation(shares(seen, self._elevations, HIGHER_M), shares(legs, self._elevations, 0.0))
        self._elevation = wanted if begins else wanted + self._keep_elevation * (self._elevation - wanted)
        (wide,), (free,) = (shares(seen, [self._elevation], beside) for beside in (NEARER_M, BESIDE_M))
        keep = self._keep_far if wide < self._share else self._keep_near
        self._share = min(free, wide if begins else wide + keep * (self._share - wide))
        end = middle + self._place.distance * self._direction(ahead, self._elevation)
        target = self._pos + self._share * self._place.look_ahead * torch.cat((ahead, ahead.new_zeros(1))) + 0.2 * up
        return seen + self._share * (end - seen), target

    def _wanted_elevation(self, of_base: list[float], of_legs: list[float]) -> float:
        """The lowest elevation (deg) at which hardly anything is in the way, or else where most of the way is free."""
        shares = [min(both) for both in zip(of_base, of_legs, strict=True)]
        best = min(ENOUGH, max(shares))
        return next(e for e, share in zip(self._elevations, shares, strict=True) if share >= best)

    def _around(self, ahead: torch.Tensor, elevation_deg: float, beside: float) -> torch.Tensor:
        """(5, 3) the camera's place and points beside it (m), from the pivot."""
        way = self._direction(ahead, elevation_deg)
        right = torch.linalg.cross(way, way.new_tensor([0.0, 0.0, 1.0]))
        right = right / right.norm()
        up = torch.linalg.cross(right, way)
        return self._place.distance * way + beside * torch.stack((0.0 * right, right, -right, up, -up))

    def _direction(self, ahead: torch.Tensor, elevation_deg: float) -> torch.Tensor:
        """(3,) unit vector from the pivot to the camera."""
        bearing, elevation = math.radians(self._place.bearing_deg), math.radians(elevation_deg)
        cos, sin = math.cos(bearing), math.sin(bearing)
        level = torch.stack((cos * ahead[0] - sin * ahead[1], sin * ahead[0] + cos * ahead[1]))
        return torch.cat((math.cos(elevation) * level, ahead.new_tensor([math.sin(elevation)])))
