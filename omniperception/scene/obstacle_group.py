"""Configuration of a group of obstacles: what they are, where they are and how they move."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

from pydantic import Field, SkipValidation

from omniperception.common.checked import (
    Area,
    AsTuple,
    AtLeastOne,
    InOrder,
    Names,
    NonNegative,
    NonNegativePair,
    Pair,
    Point,
    PositivePair,
    Share,
    checked,
)
from omniperception.scene.layouts import Layout
from omniperception.scene.meshes import own_size
from omniperception.scene.part_shapes import reach
from omniperception.scene.parts import SIZES, Part, PartConfig, check_kind, size_names
from omniperception.scene.thing_file import SUFFIXES, is_thing, parts_of

COMPOUND = "compound"
"""Kind of an obstacle of several parts."""


@checked("obstacles: approach")
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

    within: NonNegative
    distance: Pair

    def __post_init__(self) -> None:
        if not self.within < self.distance[0]:
            raise ValueError(
                f"obstacles: approach.distance={list(self.distance)} must be a range [low, high] with low >"
                f" approach.within={self.within}"
            )


_HalfTurn = Annotated[float, Field(ge=0, le=180), "in 0 to 180"]
_Sizes = Annotated[tuple[PositivePair, ...], AsTuple, "ranges 0 < low <= high"]
_Poses = Annotated[tuple[Point, ...], AsTuple, "triples (x, y, yaw_deg)"]
_Present = Annotated[tuple[Annotated[int, Field(ge=0)], int], AsTuple, InOrder, "[low, high] with 0 <= low <= high"]


@checked("obstacles: motion")
class MotionConfig:
    """Random changes of heading of what moves: after random times an obstacle stands, heads for the robot, or turns.

    Attributes:
        every_s: (low, high) range (s) of the time until it chooses again.
        turn_deg: it turns by up to this (deg) to either side, uniformly.
        stop: probability that it stands instead, until it chooses again.
        home: probability that it heads for where the robot is instead.
    """

    every_s: PositivePair
    turn_deg: _HalfTurn = 0.0
    stop: Share = 0.0
    home: Share = 0.0

    def __post_init__(self) -> None:
        if self.stop + self.home > 1:
            raise ValueError(
                f"obstacles: motion.stop={self.stop} and motion.home={self.home} must be probabilities whose sum is at"
                " most 1"
            )


@checked("obstacles: ")
class ObstacleGroup:
    """Obstacles of one kind. What is a range is drawn uniformly for every obstacle at every reset.

    Attributes:
        kind: 'box', 'cylinder', 'sphere', 'capsule', 'mesh' or 'compound'.
        count: number of them.
        size: one (low, high) range (m) per size: box half extents x, y, z; cylinder radius, half height; sphere radius;
            capsule radius, half length without its caps; mesh half extents of the box around it, none: its own. What is
            round stands upright. A mesh cannot be drawn: those of a group divide the range evenly, the first is the
            smallest. A layout brings sizes of its own.
        speed: (low, high) range (m/s); (0, 0) stands still.
        poses: fixed (x, y, yaw in degrees) of each obstacle, for walls; None: placed at every reset.
        bottom: (low, high) range (m) of the height of its lowest point above the ground; (0, 0) stands on it. Negative:
            it reaches into the ground, so that no gap opens below a long wall on a slope. A compound is lifted as a
            whole.
        heading_deg: (low, high) range (deg) of the direction in which it sets out, 0 along x.
        yaw_deg: (low, high) range (deg) of its orientation about the vertical; a compound that moves faces its way.
        area: where this group is placed and moves, in place of the preset's `area`; see `ObstaclesConfig`.
        approach: None: it keeps its heading, up to the boundary; otherwise it comes at the robot, and neither area,
            boundary nor heading apply.
        motion: None: it keeps its heading.
        file: of a mesh: one of the packaged ones (see `scene.meshes`) or a path. Rays and contacts are with its hull.
            Of a compound: an MJCF or URDF, in place of `parts`; see `thing_file`.
        files: of several obstacles that differ, in turn, in place of `file`; by `present` each environment has its own.
        swing_frequency: cycles per second of the hinges in the file of a compound.
        parts: of a compound, by name.
        scale: (low, high) range of a compound's size.
        present: (low, high) range of how many of them take part in an episode, which ones is random; None: all.
        layout: generator of the whole group's poses and sizes, one world at every reset; a group of boxes.
    """

    kind: str
    count: AtLeastOne
    size: _Sizes = ()
    speed: NonNegativePair = (0.0, 0.0)
    poses: _Poses | None = None
    bottom: Pair = (0.0, 0.0)
    heading_deg: Pair = (-180.0, 180.0)
    yaw_deg: Pair = (-180.0, 180.0)
    area: Area | None = None
    approach: ApproachConfig | None = None
    motion: MotionConfig | None = None
    file: str | None = None
    files: Names = ()
    swing_frequency: NonNegative = 0.2
    parts: Mapping[str, SkipValidation[PartConfig]] = field(default_factory=dict)
    scale: PositivePair = (1.0, 1.0)
    present: _Present | None = None
    layout: SkipValidation[Layout] | None = None

    def __post_init__(self) -> None:
        self._check_files()
        self._check_shape()
        self._check_places()
        self._check_motion()

    def _check_files(self) -> None:
        if self.files and (self.file is not None or len(self.files) > self.count):
            raise ValueError(
                f"obstacles: files={list(self.files)} with file={self.file} and count={self.count}; give either, and at"
                " least as many obstacles as files"
            )
        own = self.files or (self.file,)
        if self.kind != COMPOUND:
            for file in own:
                check_kind(self.kind, file, (*SIZES, COMPOUND))
        elif own != (None,):
            wrong = [file for file in own if file is None or not is_thing(file)]
            if wrong or self.parts:
                raise ValueError(
                    f"obstacles: a compound with file={', '.join(map(str, own))} and parts={list(self.parts)}; give"
                    f" parts, or files that end with {', '.join(SUFFIXES)}"
                )

    def file_of(self, index: int) -> str | None:
        """File of obstacle number `index`."""
        return self.files[index % len(self.files)] if self.files else self.file

    def parts_of(self, index: int) -> Mapping[str, PartConfig]:
        """Parts of obstacle number `index` of compounds."""
        file = self.file_of(index)
        return self.parts if file is None else parts_of(file, self.swing_frequency)

    def _check_shape(self) -> None:
        if self.kind != COMPOUND:
            if self.parts or self.scale != (1.0, 1.0):
                raise ValueError(f"obstacles: a {self.kind} has no parts and no scale; use kind=compound")
            own_size = self.layout is not None or self.file_of(0) is not None
            if (self.size or not own_size) and len(self.size) != len(SIZES[self.kind]):
                raise ValueError(
                    f"obstacles: a {self.kind} has {len(SIZES[self.kind])} size ranges [low, high]"
                    f" ({size_names(self.kind)}), got {len(self.size)}"
                )
            return
        every = [self.parts_of(index) for index in range(len(self.files) or 1)]
        if not all(every) or self.size:
            raise ValueError("obstacles: a compound has parts, and each of them its size; give parts, leave out size")
        meshes = [name for parts in every for name, part in parts.items() if part.kind == "mesh"]
        if meshes and self.scale[0] < self.scale[1]:
            raise ValueError(
                f"obstacles: scale={list(self.scale)} cannot vary with a mesh among the parts: {meshes[0]}"
            )

    def _check_places(self) -> None:
        if self.present is not None and self.present[1] > self.count:
            raise ValueError(f"obstacles: present={list(self.present)} must be a range within 0 to count={self.count}")
        if self.poses is not None and len(self.poses) != self.count:
            raise ValueError(f"obstacles: poses must be {self.count} triples (x, y, yaw_deg)")
        if self.layout is not None and (self.kind != "box" or self.size or self.poses is not None or self.present):
            raise ValueError("obstacles: a layout is for boxes and decides size, poses and present; leave them out")
        if self.layout is not None and self.count != self.layout.count:
            raise ValueError(f"obstacles: count={self.count} of a group must be its layout's, {self.layout.count}")

    def _check_motion(self) -> None:
        if self.has_poses and (self.approach is not None or self.moves):
            raise ValueError("obstacles: a group with fixed poses or a layout stands; leave out speed and approach")
        if self.approach is not None and self.speed[0] <= 0:
            raise ValueError(f"obstacles: speed={list(self.speed)} of a group that approaches must be positive")
        if self.motion is not None and not self.moves:
            raise ValueError(f"obstacles: speed={list(self.speed)} of a group with motion must be positive")

    @property
    def moves(self) -> bool:
        return self.speed[1] > 0

    @property
    def has_poses(self) -> bool:
        """Tell whether its obstacles have fixed poses or a layout's."""
        return self.poses is not None or self.layout is not None

    @property
    def largest_radius(self) -> float:
        """Radius (m) of the circle around the footprint of its largest obstacle."""
        if self.kind == COMPOUND:
            return self.scale[1] * max(reach(self.parts_of(index)) for index in range(len(self.files) or 1))
        alike = range(self.count - len(self.files), self.count) if self.files else [self.count - 1]
        sizes = [self.sizes_of(index) for index in alike]
        return max(math.hypot(x[1], rest[0][1] if self.kind in ("box", "mesh") else 0.0) for x, *rest in sizes)

    def sizes_of(self, index: int) -> tuple[tuple[float, float], ...]:
        """(low, high) range (m) of each size of obstacle number `index`."""
        if self.layout is not None:
            return ((0.1, 0.1),) * 3  # until the first reset
        file = self.file_of(index)
        if file is None:
            return self.size
        if not self.size:
            return tuple((half, half) for half in own_size(file))
        share = index / max(self.count - 1, 1)
        return tuple((low + share * (high - low),) * 2 for low, high in self.size)

    def make_parts(self, name: str, obstacle: int, index: int) -> tuple[Part, ...]:
        """Parts of obstacle number `index` of the group.

        Args:
            name: of the obstacle.
            obstacle: its number in the scene.
            index: its number in the group.
        """
        if self.kind != COMPOUND:
            sizes = self.sizes_of(index)
            varies = self.layout is not None or any(low < high for low, high in sizes)
            return (Part(name, obstacle, self.kind, sizes, self.file_of(index), None, self.moves, varies),)
        low, high = self.scale
        parts = []
        for key, form in self.parts_of(index).items():
            sizes = tuple((low * size, high * size) for size in form.size)
            parts.append(Part(f"{name}_{key}", obstacle, form.kind, sizes, form.file, form, self.moves, low < high))
        return tuple(parts)
