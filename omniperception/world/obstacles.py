"""Obstacles: their shapes, where they are placed, and how they move."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
import torch

from omniperception.random import EnvRandom

_GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}
_NUM_SIZES = {"box": 3, "cylinder": 2, "sphere": 1}
PARKED_HEIGHT = -100.0
"""Height (m) at which an obstacle that takes no part waits, below the ground where no ray and no contact finds it."""
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PUSH_OFF_TURNS = 16


@dataclass(frozen=True)
class ObstacleGroup:
    """Obstacles of one kind.

    Attributes:
        kind: 'box', 'cylinder' or 'sphere'; each stands on the ground.
        count: number of them.
        size: one (low, high) range (m) per size: box half extents x, y, z; cylinder radius, half height; sphere radius.
        speed: (low, high) range (m/s) from which each draws its speed at every reset; (0, 0) stands still.
        poses: fixed (x, y, yaw in degrees) of each obstacle, for walls; None: placed anew at every reset.
    """

    kind: str
    count: int
    size: Sequence[Sequence[float]]
    speed: Sequence[float] = (0.0, 0.0)
    poses: Sequence[Sequence[float]] | None = None

    def __post_init__(self) -> None:
        if self.kind not in _GEOM_TYPES:
            raise ValueError(f"obstacles: kind={self.kind} is unknown; known: {', '.join(_GEOM_TYPES)}")
        object.__setattr__(self, "size", tuple((float(low), float(high)) for low, high in self.size))
        object.__setattr__(self, "speed", tuple(float(s) for s in self.speed))
        if len(self.size) != _NUM_SIZES[self.kind]:
            raise ValueError(f"obstacles: a {self.kind} has {_NUM_SIZES[self.kind]} size ranges, got {len(self.size)}")
        if any(not 0 < low <= high for low, high in self.size):
            raise ValueError(f"obstacles: size={self.size} must be ranges 0 < low <= high")
        if self.count < 1:
            raise ValueError(f"obstacles: count={self.count} must be at least 1; leave the group out instead")
        if len(self.speed) != 2 or not 0 <= self.speed[0] <= self.speed[1]:
            raise ValueError(f"obstacles: speed={self.speed} must be a range 0 <= low <= high")
        if self.poses is not None:
            object.__setattr__(self, "poses", tuple(tuple(float(x) for x in pose) for pose in self.poses))
            if len(self.poses) != self.count or any(len(pose) != 3 for pose in self.poses):
                raise ValueError(f"obstacles: poses must be {self.count} triples (x, y, yaw_deg)")


@dataclass(frozen=True)
class Obstacle:
    """One obstacle slot; the same shape in every environment."""

    name: str
    kind: str
    size: tuple[float, ...]
    speed: tuple[float, float]
    pose: tuple[float, float, float] | None

    @property
    def half_height(self) -> float:
        return self.size[0] if self.kind == "sphere" else self.size[-1]

    @property
    def radius(self) -> float:
        """Radius (m) of the circle around its footprint."""
        return math.hypot(self.size[0], self.size[1]) if self.kind == "box" else self.size[0]


@dataclass(frozen=True)
class CurriculumConfig:
    """Raises the share and the speed of obstacles as walking improves.

    Attributes:
        start_velocity_error: the first obstacles come once the error (m/s) of the linear velocity is below.
        max_velocity_error: from then on the level rises while that error, away from obstacles, is below.
        rise: how much the level (0 to 1) rises per second of simulated time of each environment.
    """

    start_velocity_error: float = 0.25
    max_velocity_error: float = 0.25
    rise: float = 0.02

    def __post_init__(self) -> None:
        for key in ("start_velocity_error", "max_velocity_error", "rise"):
            if getattr(self, key) <= 0:
                raise ValueError(f"obstacles.curriculum.{key}={getattr(self, key)} must be positive")


@dataclass(frozen=True)
class ObstaclesConfig:
    """What stands and moves around the robot.

    Attributes:
        groups: obstacle groups by name.
        area: (x_low, x_high, y_low, y_high) in m: where obstacles are placed and move. With boundary 'bounce' it lies
            around the environment's origin, with 'wrap' around the robot.
        boundary: 'bounce': obstacles turn back at the area's edge; 'wrap': one that leaves the area enters it again
            at the opposite edge, so that a robot can walk for ever among them.
        clearance: free distance (m) kept at a reset between the robot's centre and an obstacle's edge.
        shape_seed: seed of the sizes drawn for the slots.
        curriculum: None: everything is there from the first step.
    """

    groups: Mapping[str, ObstacleGroup] = field(default_factory=dict)
    area: Sequence[float] = (-5.0, 5.0, -5.0, 5.0)
    boundary: str = "bounce"
    clearance: float = 0.8
    shape_seed: int = 0
    curriculum: CurriculumConfig | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "groups", dict(self.groups))
        object.__setattr__(self, "area", tuple(float(x) for x in self.area))
        if len(self.area) != 4 or self.area[0] >= self.area[1] or self.area[2] >= self.area[3]:
            raise ValueError(f"obstacles.area={list(self.area)} must be [x_low, x_high, y_low, y_high]")
        if self.boundary not in ("bounce", "wrap"):
            raise ValueError(f"obstacles.boundary={self.boundary} must be bounce or wrap")
        if self.clearance <= 0:
            raise ValueError(f"obstacles.clearance={self.clearance} must be positive")

    @property
    def num_obstacles(self) -> int:
        return sum(group.count for group in self.groups.values())

    def slots(self) -> tuple[Obstacle, ...]:
        """Every obstacle, sizes drawn from the groups' ranges."""
        rng = np.random.default_rng(self.shape_seed)
        slots = []
        for group_name, group in self.groups.items():
            for i in range(group.count):
                size = tuple(float(rng.uniform(low, high)) for low, high in group.size)
                pose = group.poses[i] if group.poses is not None else None
                slots.append(Obstacle(f"obstacle_{group_name}_{i}", group.kind, size, group.speed, pose))
        return tuple(slots)

    def geom_names(self) -> tuple[str, ...]:
        return tuple(slot.name for slot in self.slots())

    def placed_slots(self) -> tuple[Obstacle, ...]:
        """The obstacles that are placed anew at a reset, in the order of the kinematic bodies."""
        return tuple(slot for slot in self.slots() if slot.pose is None)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds the obstacles: fixed ones as geoms of the world, the others as kinematic (mocap) bodies."""
        for slot in self.slots():
            if slot.pose is None:
                body, pos, quat = spec.worldbody.add_body(name=slot.name, mocap=True), [0, 0, 0], [1, 0, 0, 0]
            else:
                x, y, yaw = slot.pose[0], slot.pose[1], math.radians(slot.pose[2])
                body, pos = spec.worldbody, [x, y, slot.half_height]
                quat = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
            size = list(slot.size) + [0.0] * (3 - len(slot.size))
            body.add_geom(
                name=slot.name,
                type=_GEOM_TYPES[slot.kind],
                size=size,
                pos=pos,
                quat=quat,
                contype=1,
                conaffinity=0,
                condim=3,
                friction=[0.5, 0.005, 0.0001],
            )


class ObstacleField:
    """Places and moves the kinematic obstacles of all environments.

    Attributes:
        pos_w: (num_envs, num_placed, 3) float64, m, environment frame; the simulator's own kinematic positions.
        quat_w: (num_envs, num_placed, 4) float64; the simulator's own kinematic orientations.
        velocity_w: (num_envs, num_placed, 2) float64, m/s.
        active: (num_envs, num_placed) bool: whether an obstacle takes part in the current episode.
        level: share of obstacles and of their speed that the curriculum lets in, 0 to 1.
    """

    def __init__(self, config: ObstaclesConfig, pos_w: torch.Tensor, quat_w: torch.Tensor, random: EnvRandom) -> None:
        self.config = config
        self.pos_w, self.quat_w = pos_w, quat_w
        slots = config.placed_slots()
        device = pos_w.device
        self.radius = torch.tensor([s.radius for s in slots], dtype=torch.float64, device=device)
        self._half_height = torch.tensor([s.half_height for s in slots], dtype=torch.float64, device=device)
        self._speed_low = torch.tensor([s.speed[0] for s in slots], dtype=torch.float64, device=device)
        self._speed_high = torch.tensor([s.speed[1] for s in slots], dtype=torch.float64, device=device)
        x_low, x_high, y_low, y_high = config.area
        self._low = torch.tensor([x_low, y_low], dtype=torch.float64, device=device)
        self._high = torch.tensor([x_high, y_high], dtype=torch.float64, device=device)
        self._random = random
        self._any_moves = any(s.speed[1] > 0 for s in slots)
        self.velocity_w = torch.zeros(pos_w.shape[0], len(slots), 2, dtype=torch.float64, device=device)
        self.active = torch.zeros(pos_w.shape[0], len(slots), dtype=torch.bool, device=device)
        self.level = 1.0 if config.curriculum is None else 0.0

    def reset(self, env_ids: torch.Tensor, robot_xy_w: torch.Tensor) -> None:
        """Places the obstacles of some environments anew.

        Args:
            env_ids: (n,) environments.
            robot_xy_w: (n, 2) where the robot stands, m.
        """
        shape = (self.pos_w.shape[1],)
        u = self._random.uniform(env_ids, (6, *shape)).double()
        anchor = robot_xy_w.double()[:, None] if self.config.boundary == "wrap" else 0.0
        xy = self._low + torch.stack((u[:, 0], u[:, 1]), -1) * (self._high - self._low) + anchor
        xy = self._push_off(xy, robot_xy_w.double())
        speed = (self._speed_low + u[:, 3] * (self._speed_high - self._speed_low)) * self.level
        heading, yaw = 2 * math.pi * u[:, 4], 2 * math.pi * u[:, 2]
        active = u[:, 5] < self.level
        self.active[env_ids] = active
        self.velocity_w[env_ids] = torch.stack((heading.cos(), heading.sin()), -1) * (speed * active)[..., None]
        z = torch.where(active, self._half_height, PARKED_HEIGHT)
        self.pos_w[env_ids] = torch.cat((xy, z[..., None]), -1)
        zero = torch.zeros_like(yaw)
        self.quat_w[env_ids] = torch.stack(((yaw / 2).cos(), zero, zero, (yaw / 2).sin()), -1)

    def advance(self, dt: float, robot_xy_w: torch.Tensor) -> None:
        """Moves every obstacle by `dt` (s); `robot_xy_w` (num_envs, 2) is the centre of a wrapping area."""
        if self._any_moves:
            self.pos_w[..., :2] += self.velocity_w * dt
        if self.config.boundary == "bounce":
            if self._any_moves:
                self._bounce()
        else:
            self._wrap(robot_xy_w)

    def raise_level(self, velocity_error: float, seconds: float) -> None:
        """Raises the curriculum's level while the robot walks well (`velocity_error` in m/s)."""
        curriculum = self.config.curriculum
        if curriculum is None:
            return
        bound = curriculum.max_velocity_error if self.level > 0 else curriculum.start_velocity_error
        if velocity_error < bound:
            self.level = min(1.0, self.level + curriculum.rise * seconds)

    def state_dict(self) -> dict:
        """What `load_state_dict` needs to go on; positions belong to the simulator's state."""
        return {"velocity_w": self.velocity_w.clone(), "active": self.active.clone(), "level": self.level}

    def load_state_dict(self, state: dict) -> None:
        self.velocity_w.copy_(state["velocity_w"])
        self.active.copy_(state["active"])
        self.level = state["level"]

    def _push_off(self, xy: torch.Tensor, robot_xy: torch.Tensor) -> torch.Tensor:
        """Moves obstacles that would stand on the robot radially out of its clearance, inside the area."""
        keep = self.config.clearance + self.radius
        offset = xy - robot_xy[:, None]
        bearing = torch.atan2(offset[..., 1], offset[..., 0])
        for turn in range(_PUSH_OFF_TURNS):  # another direction each time, for robots close to an edge
            near = (xy - robot_xy[:, None]).norm(dim=-1) < keep
            if not near.any():
                break
            angle = bearing + turn * _GOLDEN_ANGLE
            outside = robot_xy[:, None] + torch.stack((angle.cos(), angle.sin()), -1) * (keep + 1e-6)[:, None]
            xy = torch.where(near[..., None], outside, xy)
            if self.config.boundary == "bounce":
                xy = xy.clamp(self._low, self._high)
        return xy

    def _bounce(self) -> None:
        xy = self.pos_w[..., :2]
        below, above = xy < self._low, xy > self._high
        inward = torch.where(below, self.velocity_w.abs(), torch.where(above, -self.velocity_w.abs(), self.velocity_w))
        self.velocity_w.copy_(inward)
        xy.copy_(torch.where(below, 2 * self._low - xy, torch.where(above, 2 * self._high - xy, xy)))

    def _wrap(self, robot_xy_w: torch.Tensor) -> None:
        low = self._low + robot_xy_w.double()[:, None]
        xy = self.pos_w[..., :2]
        xy.copy_(low + torch.remainder(xy - low, self._high - self._low))
