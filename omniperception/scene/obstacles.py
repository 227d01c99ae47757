"""Configuration of obstacles: shapes, placement and motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco

from omniperception.scene.parts import SIZES, Part


@dataclass(frozen=True)
class ApproachConfig:
    """Approach of obstacles to the robot: each walks straight on, on a course that leads past the robot.

    One starts at a random bearing, all sides alike. Its course is such that its centre would pass within `within` of
    the robot's base if the robot kept the velocity that it is commanded at that moment; where no course does because
    the robot outruns it, it heads for where the robot is. Once it is farther than `distance[1]` + 1 m from the robot
    it starts again.

    Attributes:
        within: (m); the miss distance is uniform in [-within, within].
        distance: (low, high) range (m) of the distance from the robot at which one starts.
    """

    within: float
    distance: Sequence[float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "distance", tuple(float(d) for d in self.distance))
        if self.within < 0:
            raise ValueError(f"obstacles: approach.within={self.within} must not be negative")
        if len(self.distance) != 2 or not self.within < self.distance[0] <= self.distance[1]:
            raise ValueError(
                f"obstacles: approach.distance={list(self.distance)} must be a range [low, high] with low >"
                f" approach.within={self.within}"
            )


@dataclass(frozen=True)
class ObstacleGroup:
    """Obstacles of one kind. What is a range is drawn uniformly for every obstacle at every reset.

    Attributes:
        kind: 'box', 'cylinder', 'sphere' or 'capsule'.
        count: number of them.
        size: one (low, high) range (m) per size: box half extents x, y, z; cylinder radius, half height; sphere radius;
            capsule radius, half length without its caps. What is round stands upright.
        speed: (low, high) range (m/s); (0, 0) stands still.
        poses: fixed (x, y, yaw in degrees) of each obstacle, for walls; None: placed at every reset.
        bottom: (low, high) range (m) of the height of its lowest point above the ground; (0, 0) stands on it. Negative:
            it reaches into the ground, so that no gap opens below a long wall on a slope.
        heading_deg: (low, high) range (deg) of the direction in which it sets out, 0 along x.
        yaw_deg: (low, high) range (deg) of its orientation about the vertical.
        area: where this group is placed and moves, in place of the preset's `area`; see `ObstaclesConfig`.
        approach: None: it keeps its heading, up to the boundary; otherwise it comes at the robot, and neither area,
            boundary nor heading apply.
    """

    kind: str
    count: int
    size: Sequence[Sequence[float]]
    speed: Sequence[float] = (0.0, 0.0)
    poses: Sequence[Sequence[float]] | None = None
    bottom: Sequence[float] = (0.0, 0.0)
    heading_deg: Sequence[float] = (-180.0, 180.0)
    yaw_deg: Sequence[float] = (-180.0, 180.0)
    area: Sequence[float] | None = None
    approach: ApproachConfig | None = None

    def __post_init__(self) -> None:
        if self.kind not in SIZES:
            raise ValueError(f"obstacles: kind={self.kind} is unknown; known: {', '.join(SIZES)}")
        object.__setattr__(self, "size", tuple((float(low), float(high)) for low, high in self.size))
        object.__setattr__(self, "speed", tuple(float(s) for s in self.speed))
        if len(self.size) != len(SIZES[self.kind]):
            raise ValueError(
                f"obstacles: a {self.kind} has {len(SIZES[self.kind])} size ranges ({', '.join(SIZES[self.kind])}), got"
                f" {len(self.size)}"
            )
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
        for key in ("bottom", "heading_deg", "yaw_deg"):
            bounds = tuple(float(bound) for bound in getattr(self, key))
            object.__setattr__(self, key, bounds)
            if len(bounds) != 2 or bounds[0] > bounds[1]:
                raise ValueError(f"obstacles: {key}={list(bounds)} must be a range [low, high] with low <= high")
        if self.area is not None:
            object.__setattr__(self, "area", _area("a group's area", self.area))
        if self.poses is not None and (self.approach is not None or self.moves):
            raise ValueError("obstacles: a group with fixed poses stands; leave out speed and approach")
        if self.approach is not None and self.speed[0] <= 0:
            raise ValueError(f"obstacles: speed={list(self.speed)} of a group that approaches must be positive")

    @property
    def moves(self) -> bool:
        return self.speed[1] > 0

    @property
    def largest_radius(self) -> float:
        """Radius (m) of the circle around the footprint of its largest obstacle."""
        x, y = self.size[0][1], self.size[1][1] if self.kind == "box" else 0.0
        return math.hypot(x, y)


def _area(name: str, bounds: Sequence[float]) -> tuple[float, float, float, float]:
    area = tuple(float(x) for x in bounds)
    if len(area) != 4 or area[0] >= area[1] or area[2] >= area[3]:
        raise ValueError(f"obstacles: {name}={list(area)} must be [x_low, x_high, y_low, y_high]")
    return area


@dataclass(frozen=True)
class Obstacle:
    """One obstacle: it is placed and moves as a whole.

    Attributes:
        name: of the obstacle.
        group: its group.
        pose: its fixed (x, y, yaw in degrees), if any.
    """

    name: str
    group: ObstacleGroup
    pose: tuple[float, float, float] | None

    def parts(self, index: int) -> tuple[Part, ...]:
        """Its bodies, where it is obstacle number `index` of the scene."""
        size = tuple((low, high) for low, high in self.group.size)
        return (Part(self.name, index, self.group, self.group.kind, size),)


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
class FreePathConfig:
    """A way from the robot's start to its goal that no standing obstacle blocks, drawn at every reset.

    It is the set of points within width / 2 of a line with two bends: from the start over one point each at a third
    and at two thirds of the way, both off the straight line by up to `bend` to either side, to the goal.

    Attributes:
        width: (m).
        bend: (m).
    """

    width: float
    bend: float

    def __post_init__(self) -> None:
        if self.width <= 0:
            raise ValueError(f"obstacles.free_path.width={self.width} must be positive")
        if self.bend < 0:
            raise ValueError(f"obstacles.free_path.bend={self.bend} must not be negative")


@dataclass(frozen=True)
class ObstaclesConfig:
    """Configuration of the obstacles around the robot.

    Attributes:
        groups: obstacle groups by name.
        area: (x_low, x_high, y_low, y_high) in m: where obstacles are placed and move. With boundary 'bounce' it lies
            around the environment's origin, with 'wrap' around the robot.
        boundary: 'bounce': obstacles turn back at the area's edge; 'wrap': one that leaves the area enters it again
            at the opposite edge, so that a robot can walk for ever among them.
        clearance: free distance (m) kept at a reset between the robot's centre and an obstacle's edge.
        curriculum: None: everything is there from the first step.
        spacing: free distance (m) kept at a reset between the edges of any two standing obstacles, so that a robot fits
            through; 0 lets them overlap.
        free_path: a way to the goal that standing obstacles keep free; None for none.
        headroom: spacing and free path do not count obstacles that hang at least this high (m).

    Edges are those of the circles around the footprints. A standing obstacle that finds no place with the spacing and
    off the free path is left out of the episode.
    """

    groups: Mapping[str, ObstacleGroup] = field(default_factory=dict)
    area: Sequence[float] = (-5.0, 5.0, -5.0, 5.0)
    boundary: str = "bounce"
    clearance: float = 0.8
    curriculum: CurriculumConfig | None = None
    spacing: float = 0.0
    free_path: FreePathConfig | None = None
    headroom: float = 0.45

    def __post_init__(self) -> None:
        object.__setattr__(self, "groups", dict(self.groups))
        object.__setattr__(self, "area", _area("area", self.area))
        if self.boundary not in ("bounce", "wrap"):
            raise ValueError(f"obstacles.boundary={self.boundary} must be bounce or wrap")
        if self.clearance <= 0:
            raise ValueError(f"obstacles.clearance={self.clearance} must be positive")
        for key in ("spacing", "headroom"):
            if getattr(self, key) < 0:
                raise ValueError(f"obstacles.{key}={getattr(self, key)} must not be negative")
        for name, group in self.groups.items():
            approach, least = group.approach, self.clearance + group.largest_radius
            if approach is not None and approach.distance[0] < least:
                raise ValueError(
                    f"obstacles: approach.distance={list(approach.distance)} lets those of {name} start on the robot;"
                    f" its low end must be at least clearance + radius = {least:.2f}"
                )

    @property
    def num_obstacles(self) -> int:
        return sum(group.count for group in self.groups.values())

    def obstacles(self) -> tuple[Obstacle, ...]:
        """Every obstacle, group by group."""
        found = []
        for name, group in self.groups.items():
            for i in range(group.count):
                x_y_yaw = None if group.poses is None else group.poses[i]
                pose = None if x_y_yaw is None else (x_y_yaw[0], x_y_yaw[1], x_y_yaw[2])
                found.append(Obstacle(f"obstacle_{name}_{i}", group, pose))
        return tuple(found)

    def parts(self) -> tuple[Part, ...]:
        """The parts of all obstacles, in the order of the kinematic bodies."""
        return tuple(part for index, obstacle in enumerate(self.obstacles()) for part in obstacle.parts(index))

    def geom_names(self) -> tuple[str, ...]:
        return tuple(part.name for part in self.parts())

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds the parts as kinematic (mocap) bodies."""
        for part in self.parts():
            part.add_to(spec)
