"""What stands and moves around the base, by azimuth sector, from the true poses and outlines of all obstacles."""

from __future__ import annotations

import math

import torch
import warp as wp

from omniperception.avoidance.sector_motion import nothing_near
from omniperception.common.launch import launch_over_envs, view
from omniperception.common.rotations import rotate_yaw
from omniperception.scene import ObstacleField, ObstaclesConfig


class TrueSectors:
    """Nearest obstacle of each azimuth sector: how far its outline is from the base, and how it moves.

    Sector j of S holds the bearings [-pi + j 2 pi / S, -pi + (j + 1) 2 pi / S) of the yaw-aligned frame. An obstacle is
    in a sector if the sector's middle points at it, at the distance along the middle, or if its nearest point lies
    there; one that reaches in from the side alone is not, so that wide things do not look wider than they are. Outlines
    are circles and rectangles, seen from above. Obstacles that do not take part, or that hang at least
    `ObstaclesConfig.headroom` above the ground, do not count.

    Attributes:
        names: of the obstacles, in the order of the masks.
    """

    def __init__(
        self,
        num_sectors: int,
        obstacles: ObstaclesConfig,
        field: ObstacleField | None,
        num_envs: int,
        device: torch.device,
    ) -> None:
        """Args: num_sectors: S; obstacles: every obstacle; field: where the placed ones are, or None without any."""
        self.num_sectors, self._field, self._num_envs, self._device = num_sectors, field, num_envs, device
        self._headroom = obstacles.headroom
        slots = obstacles.slots()
        placed = [slot for slot in slots if slot.pose is None]
        fixed = [slot for slot in slots if slot.pose is not None]
        self.names = tuple(slot.name for slot in (*placed, *fixed))
        outlines = [(*slot.size, 0.0)[:2] if slot.kind == "box" else (slot.size[0], -1.0) for slot in (*placed, *fixed)]
        self._outline = torch.tensor(outlines, device=device).reshape(-1, 2)
        poses = torch.tensor([slot.pose for slot in fixed], device=device).reshape(-1, 3)
        self._fixed_xy, self._fixed_yaw = poses[:, :2], torch.deg2rad(poses[:, 2])

    def measure(self, base_pos_w: torch.Tensor, yaw: torch.Tensor, known: torch.Tensor | None = None) -> torch.Tensor:
        """Distances and velocities at the present state of the obstacles.

        Args:
            base_pos_w: (num_envs, 3) m, where the robots are.
            yaw: (num_envs,) rad, their headings.
            known: (num_envs, O) bool the obstacles that count; None for all.

        Returns:
            (num_envs, S, 3) distance (m, horizontal, infinite without an obstacle) and velocity (m/s, yaw-aligned).
        """
        out = nothing_near(self._num_envs, self.num_sectors, self._device)
        if len(self._outline):
            xy, obstacle_yaw, velocity, counts = self._obstacles()
            if known is not None:
                counts = counts & known
            place = rotate_yaw(-yaw, xy - base_pos_w[:, None, :2])
            velocity = rotate_yaw(-yaw, velocity)
            heading = obstacle_yaw - yaw[:, None]
            axis = torch.stack((heading.cos(), heading.sin()), -1)
            inputs = [
                view(place, wp.vec2),
                view(axis, wp.vec2),
                view(velocity, wp.vec2),
                view(counts, wp.bool),
                view(self._outline, wp.vec2),
                view(out, wp.vec3),
            ]
            launch_over_envs(nearest_by_sector, self._num_envs, inputs, self._device)
        return out

    def _obstacles(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Places (n, O, 2), yaw angles (n, O), velocities (n, O, 2), and which count (n, O)."""
        n, field = self._num_envs, self._field
        fixed_xy, fixed_yaw = self._fixed_xy.expand(n, -1, -1), self._fixed_yaw.expand(n, -1)
        still, always = torch.zeros_like(fixed_xy), torch.ones_like(fixed_yaw, dtype=torch.bool)
        if field is None:
            return fixed_xy, fixed_yaw, still, always
        counts = field.active & (field.bottom_above_ground() < self._headroom)
        return (
            torch.cat((field.pos_w[..., :2].float(), fixed_xy), 1),
            torch.cat((field.yaw.float(), fixed_yaw), 1),
            torch.cat((field.velocity_w.float(), still), 1),
            torch.cat((counts, always), 1),
        )


@wp.func
def slab(start: float, direction: float, half: float):
    """Where a line enters and leaves |x| <= half."""
    step = direction
    if wp.abs(step) < 1.0e-9:
        step = wp.float32(1.0e-9)
    a = (-half - start) / step
    b = (half - start) / step
    return wp.vec2(wp.min(a, b), wp.max(a, b))


@wp.func
def entry(place: wp.vec2, axis: wp.vec2, outline: wp.vec2, direction: wp.vec2) -> float:
    """Distance at which a ray from the origin enters an outline, 0 inside, infinite if it misses."""
    if outline[1] < 0.0:
        along = wp.dot(place, direction)
        chord = outline[0] * outline[0] - wp.dot(place, place) + along * along
        if chord <= 0.0 or along + wp.sqrt(chord) <= 0.0:
            return wp.inf
        return wp.max(along - wp.sqrt(chord), 0.0)
    across = wp.vec2(-axis[1], axis[0])
    x = slab(-wp.dot(place, axis), wp.dot(direction, axis), outline[0])
    y = slab(-wp.dot(place, across), wp.dot(direction, across), outline[1])
    enter = wp.max(x[0], y[0])
    leave = wp.min(x[1], y[1])
    if enter > leave or leave <= 0.0:
        return wp.inf
    return wp.max(enter, 0.0)


@wp.func
def nearest_point(place: wp.vec2, axis: wp.vec2, outline: wp.vec2) -> wp.vec2:
    """The point of an outline that is nearest to the origin."""
    if outline[1] < 0.0:
        return place * wp.max(1.0 - outline[0] / wp.max(wp.length(place), 1.0e-9), 0.0)
    across = wp.vec2(-axis[1], axis[0])
    x = wp.clamp(-wp.dot(place, axis), -outline[0], outline[0])
    y = wp.clamp(-wp.dot(place, across), -outline[1], outline[1])
    return place + x * axis + y * across


@wp.func
def keep_nearer(distance: float, velocity: wp.vec2, sector: wp.vec3) -> wp.vec3:
    if distance < sector[0]:
        return wp.vec3(distance, velocity[0], velocity[1])
    return sector


@wp.kernel(module="unique", enable_backward=False)
def nearest_by_sector(
    env_offset: int,
    place: wp.array2d(dtype=wp.vec2),
    axis: wp.array2d(dtype=wp.vec2),
    velocity: wp.array2d(dtype=wp.vec2),
    counts: wp.array2d(dtype=wp.bool),
    outline: wp.array(dtype=wp.vec2),
    # out
    sectors_out: wp.array2d(dtype=wp.vec3),
):
    """Every obstacle of one environment in turn; see `TrueSectors`."""
    env = wp.tid() + env_offset
    num_sectors = sectors_out.shape[1]
    width = 2.0 * wp.static(math.pi) / float(num_sectors)
    for o in range(place.shape[1]):
        if counts[env, o]:
            p = place[env, o]
            a = axis[env, o]
            w = velocity[env, o]
            near = nearest_point(p, a, outline[o])
            bearing = wp.atan2(near[1], near[0]) + wp.static(math.pi)
            own = wp.min(int(bearing / width), num_sectors - 1)
            sectors_out[env, own] = keep_nearer(wp.length(near), w, sectors_out[env, own])
            for s in range(num_sectors):
                angle = (float(s) + 0.5) * width - wp.static(math.pi)
                distance = entry(p, a, outline[o], wp.vec2(wp.cos(angle), wp.sin(angle)))
                if distance < sectors_out[env, s][0]:
                    sectors_out[env, s] = keep_nearer(distance, w, sectors_out[env, s])
