"""Parts of obstacles: one kinematic body with one geom each; their configuration and kinds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import mujoco
from pydantic import Field

from omniperception.common.checked import AsTuple, NonNegative, Point, checked
from omniperception.scene.meshes import check_mesh, mesh_points, own_size

SIZES = {
    "box": ("half x", "half y", "half z"),
    "cylinder": ("radius", "half height"),
    "sphere": ("radius",),
    "capsule": ("radius", "half length"),
    "mesh": ("half x", "half y", "half z"),
}
"""Sizes (m) of each kind, in MuJoCo's order; those of a mesh are of the box around it."""
GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_Amplitude = Annotated[float, Field(gt=0, le=180), "above 0, up to 180"]
_Lengths = Annotated[tuple[Annotated[float, Field(gt=0)], ...], AsTuple, "positive sizes (m)"]


@checked("obstacles: swing")
class SwingConfig:
    """Swing of a part about its joint: its angle is amplitude sin(2 pi c + phase) after c cycles.

    All of an obstacle's parts begin at the same c, drawn at every reset.

    Attributes:
        axis: 'x', 'y' or 'z' of the part's own frame, or a direction (x, y, z) in it.
        amplitude_deg: (deg).
        frequency: cycles per second.
        per_metre: cycles per metre that the obstacle moves.
        phase_deg: (deg).
    """

    axis: Literal["x", "y", "z"] | Point
    amplitude_deg: _Amplitude
    frequency: NonNegative = 0.0
    per_metre: NonNegative = 0.0
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        if not any(self.axis):
            raise ValueError("obstacles: swing.axis=[0, 0, 0] has no direction")
        if (self.frequency > 0) == (self.per_metre > 0):
            raise ValueError(
                f"obstacles: swing has frequency={self.frequency} and per_metre={self.per_metre}; give one of them,"
                " positive"
            )

    @property
    def direction(self) -> tuple[float, ...]:
        """(3,) of unit length: the axis in the part's own frame."""
        x, y, z = AXES[self.axis] if isinstance(self.axis, str) else self.axis
        length = math.hypot(x, y, z)
        return x / length, y / length, z / length


@checked("obstacles: ")
class PartConfig:
    """A part of a compound, in a frame on the ground below the obstacle, x ahead, at scale 1.

    Attributes:
        kind: one of `SIZES`.
        size: its sizes (m); see `SIZES`. None is the mesh's own.
        pos: of its joint (m); where it has no `hang`, of its middle.
        rpy_deg: roll, pitch and yaw (deg) of its frame, turned in this order about fixed axes.
        hang: how far its middle lies below the joint (m), or where from the joint (x, y, z) in its own frame.
        swing: None: it does not move against the others.
        file: of a mesh; see `ObstacleGroup`.
    """

    kind: str
    size: _Lengths = ()
    pos: Point = (0.0, 0.0, 0.0)
    rpy_deg: Point = (0.0, 0.0, 0.0)
    hang: float | Point = 0.0
    swing: SwingConfig | None = None
    file: str | None = None

    def __post_init__(self) -> None:
        check_kind(self.kind, self.file, tuple(SIZES))
        if isinstance(self.hang, float):
            object.__setattr__(self, "hang", (0.0, 0.0, -self.hang))
        if self.file is not None and not self.size:
            object.__setattr__(self, "size", own_size(self.file))
        if len(self.size) != len(SIZES[self.kind]):
            raise ValueError(
                f"obstacles: size={list(self.size)} of a {self.kind} must be positive: {size_names(self.kind)}"
            )


def check_kind(kind: str, file: str | None, known: Sequence[str]) -> None:
    """Raises a ValueError in one line if a kind is unknown, or its file is missing or out of place."""
    if kind not in known:
        raise ValueError(f"obstacles: kind={kind} is unknown; known: {', '.join(known)}")
    if (kind == "mesh") != (file is not None):
        raise ValueError(f"obstacles: a {kind} with file={file}; a mesh needs a file, and nothing else has one")
    if file is not None:
        check_mesh(file)


def size_names(kind: str) -> str:
    """Names of a kind's sizes, in words."""
    return ", ".join(SIZES[kind])


@dataclass(frozen=True)
class Part:
    """One kinematic body with one geom of the same name.

    Attributes:
        name: of the body and of the geom.
        obstacle: index of the obstacle that it belongs to.
        kind: one of `SIZES`.
        size: one (low, high) range (m) per size; within a compound all sizes vary together.
        file: of a mesh.
        form: how it belongs to its compound; None where it is the whole obstacle.
        moves: whether its obstacle moves.
        varies: whether its size differs between environments.
    """

    name: str
    obstacle: int
    kind: str
    size: tuple[tuple[float, float], ...]
    file: str | None = None
    form: PartConfig | None = None
    moves: bool = False
    varies: bool = False

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds body and geom, as large as the part can be."""
        size, more = [high for _, high in self.size] + [0.0] * (3 - len(self.size)), {}
        if self.file is not None:
            points = mesh_points(self.file)[0] * size
            spec.add_mesh(name=self.name, uservert=points.flatten().tolist())  # without faces: their convex hull
            size, more = [0.0] * 3, {"meshname": self.name}
        body = spec.worldbody.add_body(name=self.name, mocap=True)
        body.add_geom(
            name=self.name,
            type=GEOM_TYPES[self.kind],
            size=size,
            contype=1,
            conaffinity=0,
            condim=3,
            friction=[0.5, 0.005, 0.0001],
            **more,
        )
