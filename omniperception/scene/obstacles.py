"""Configuration of the obstacles of a scene: all groups and what holds for all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import mujoco
from pydantic import SkipValidation

from omniperception.common.checked import Area, NonNegative, Positive, checked
from omniperception.scene.layouts import CorridorLayout, MazeLayout
from omniperception.scene.obstacle_group import ObstacleGroup
from omniperception.scene.parts import Part


@dataclass(frozen=True)
class Obstacle:
    """One obstacle: it is placed and moves as a whole.

    Attributes:
        name: of the obstacle.
        group: its group.
        index: its number in the group.
    """

    name: str
    group: ObstacleGroup
    index: int

    @property
    def pose(self) -> Sequence[float] | None:
        """Its fixed (x, y, yaw in degrees), if any."""
        return None if self.group.poses is None else self.group.poses[self.index]


@checked("obstacles.curriculum")
class ObstacleCurriculumConfig:
    """Raises the share and the speed of obstacles as walking improves.

    Attributes:
        start_velocity_error: the first obstacles come once the error (m/s) of the linear velocity is below.
        max_velocity_error: from then on the level rises while that error, away from obstacles, is below.
        rise: how much the level (0 to 1) rises per second of simulated time of each environment.
    """

    start_velocity_error: Positive = 0.25
    max_velocity_error: Positive = 0.25
    rise: Positive = 0.02


@checked("obstacles.free_path")
class FreePathConfig:
    """A path from the robot's start to its goal that no standing obstacle blocks, drawn at every reset.

    It is the set of points within width / 2 of a line with two bends: from the start over one point each at a third
    and at two thirds of it, both off the straight line by up to `bend` to either side, to the goal.

    Attributes:
        width: (m).
        bend: (m).
    """

    width: Positive
    bend: NonNegative


@checked("obstacles")
class ObstaclesConfig:
    """Configuration of the obstacles around the robot.

    Attributes:
        groups: obstacle groups by name.
        area: (x_low, x_high, y_low, y_high) in m: where obstacles are placed and move. With boundary 'bounce' it lies
            around the environment's origin, with 'wrap' around the robot. A layout of corridors gives each world one.
        boundary: 'bounce': obstacles turn back at the area's edge; 'wrap': one that leaves the area enters it again
            at the opposite edge, however near that is to the robot, so that a robot can walk for ever among them.
        clearance: free distance (m) kept at a reset between the robot's centre and an obstacle's edge; what finds no
            place in its area that keeps it is not there in that episode.
        curriculum: None: everything is there from the first step.
        spacing: free distance (m) kept at a reset between the edges of any two standing obstacles that are placed, so
            that a robot fits through; 0 lets them overlap. Those with poses are not placed, and keep none.
        free_path: a path to the goal that standing obstacles that are placed keep free; None for none.
        headroom: spacing and free path do not count obstacles that hang at least this high (m).
        split: 'dev' or 'test': the scenes for choosing anything, and those for reports, which no training may see.
            `build.assemble` turns those of 'test' into `held_out` ones; here it chooses the worlds of layouts.

    Edges are those of the circles around the footprints. A standing obstacle that finds no place with the spacing and
    off the free path is left out of the episode.
    """

    groups: Mapping[str, SkipValidation[ObstacleGroup]] = field(default_factory=dict)
    area: Area = (-5.0, 5.0, -5.0, 5.0)
    boundary: Literal["bounce", "wrap"] = "bounce"
    clearance: Positive = 0.8
    curriculum: ObstacleCurriculumConfig | None = None
    spacing: NonNegative = 0.0
    free_path: FreePathConfig | None = None
    headroom: NonNegative = 0.45
    split: Literal["dev", "test"] = "dev"

    def __post_init__(self) -> None:
        corridors = [name for name, group in self.groups.items() if isinstance(group.layout, CorridorLayout)]
        if len(corridors) > 1 or (corridors and self.boundary == "wrap"):
            raise ValueError(
                f"obstacles: {', '.join(corridors)} with boundary={self.boundary}; a scene has one layout of corridors"
                " at most, which stays where it is: use boundary=bounce"
            )
        for name, group in self.groups.items():
            approach, least = group.approach, self.clearance + group.largest_radius
            if approach is not None and approach.distance[0] < least:
                raise ValueError(
                    f"obstacles: approach.distance={list(approach.distance)} lets those of {name} start on the robot;"
                    f" its low end must be at least clearance + radius = {least:.2f}"
                )
            x_low, x_high, y_low, y_high = group.area or self.area
            drawn = approach is None and not group.has_poses
            if drawn and 2 * group.largest_radius > math.hypot(x_high - x_low, y_high - y_low):
                raise ValueError(
                    f"obstacles.groups.{name} are {2 * group.largest_radius:.4g} m across, and the area that they are"
                    f" placed in {x_high - x_low:g} m x {y_high - y_low:g} m; give size (half extents, m), scale or"
                    " poses, or a file in metres"
                )

    @property
    def route_end(self) -> tuple[float, float] | None:
        """Where (m) routes through the obstacles' worlds lead, for `commands.route_ahead`; None: there are none."""
        layouts = [group.layout for group in self.groups.values() if group.layout is not None]
        return layouts[0].goal if len(layouts) == 1 and isinstance(layouts[0], MazeLayout) else None

    @property
    def num_obstacles(self) -> int:
        return sum(group.count for group in self.groups.values())

    def obstacles(self) -> tuple[Obstacle, ...]:
        """Every obstacle, group by group."""
        named = self.groups.items()
        return tuple(Obstacle(f"obstacle_{name}_{i}", group, i) for name, group in named for i in range(group.count))

    def parts(self) -> tuple[Part, ...]:
        """The parts of all obstacles, in the order of the kinematic bodies."""
        numbered = enumerate(self.obstacles())
        return tuple(part for k, own in numbered for part in own.group.make_parts(own.name, k, own.index))

    def geom_names(self) -> tuple[str, ...]:
        return tuple(part.name for part in self.parts())

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds the parts as kinematic (mocap) bodies."""
        for part in self.parts():
            part.add_to(spec)
