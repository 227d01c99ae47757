"""Parts of obstacles: one kinematic body with one geom each; kinds, sizes, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import torch

if TYPE_CHECKING:
    from omniperception.scene.obstacles import ObstacleGroup

SIZES = {
    "box": ("half x", "half y", "half z"),
    "cylinder": ("radius", "half height"),
    "sphere": ("radius",),
    "capsule": ("radius", "half length"),
}
"""Sizes (m) of each kind, in MuJoCo's order; round kinds stand upright."""
_GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
_ROUND = ("cylinder", "sphere", "capsule")
_HALF_HEIGHT = {"box": (0, 0, 1), "cylinder": (0, 1, 0), "sphere": (1, 0, 0), "capsule": (1, 1, 0)}
"""How often each size counts in the half height."""


@dataclass(frozen=True)
class Part:
    """One kinematic body with one geom of the same name.

    Attributes:
        name: of the body and of the geom.
        obstacle: index of the obstacle that it belongs to.
        group: of that obstacle.
        kind: one of `SIZES`.
        size: one (low, high) range (m) per size.
    """

    name: str
    obstacle: int
    group: ObstacleGroup
    kind: str
    size: tuple[tuple[float, float], ...]

    @property
    def varies(self) -> bool:
        """Tell whether its size differs between environments."""
        return any(low < high for low, high in self.size)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Adds body and geom, as large as the part can be."""
        body = spec.worldbody.add_body(name=self.name, mocap=True)
        body.add_geom(
            name=self.name,
            type=_GEOM_TYPES[self.kind],
            size=[high for _, high in self.size] + [0.0] * (3 - len(self.size)),
            contype=1,
            conaffinity=0,
            condim=3,
            friction=[0.5, 0.005, 0.0001],
        )


class PartShapes:
    """Sizes of all parts, drawn from their ranges, and what follows from sizes (n, P, 3), padded with 0."""

    def __init__(self, parts: Sequence[Part], dtype: torch.dtype, device: torch.device) -> None:
        def column(rows: list) -> torch.Tensor:
            return torch.tensor(rows, dtype=dtype, device=device).reshape(len(parts), -1)

        padded = [[*part.size, *[(0.0, 0.0)] * (3 - len(part.size))] for part in parts]
        self._low = column([[low for low, _ in ranges] for ranges in padded])
        self._high = column([[high for _, high in ranges] for ranges in padded])
        self._round = torch.tensor([part.kind in _ROUND for part in parts], device=device)
        self._to_half_height = column([_HALF_HEIGHT[part.kind] for part in parts])

    def draw(self, u: torch.Tensor) -> torch.Tensor:
        """Sizes (n, P, 3) in m from draws (n, 3, P)."""
        return self._low + u.transpose(1, 2) * (self._high - self._low)

    def half_height(self, size: torch.Tensor) -> torch.Tensor:
        """(n, P) m."""
        return (size * self._to_half_height).sum(-1)

    def outline(self, size: torch.Tensor) -> torch.Tensor:
        """(n, P, 2) m: half x, half y of the rectangle seen from above; radius, -1 of a circle."""
        return torch.stack((size[..., 0], torch.where(self._round, -1.0, size[..., 1])), -1)

    def radius(self, size: torch.Tensor) -> torch.Tensor:
        """(n, P) m, of the circle around what is seen from above."""
        return torch.where(self._round, size[..., 0], torch.hypot(size[..., 0], size[..., 1]))
