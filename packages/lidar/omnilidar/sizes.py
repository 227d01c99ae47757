"""Sizes of shapes that every environment has of its own: which numbers count, and what holds the shapes."""

from collections.abc import Sequence

import torch

from .shapes import SIZE_NAMES, ShapeKind

PRIMITIVES = (ShapeKind.BOX, ShapeKind.SPHERE, ShapeKind.CYLINDER, ShapeKind.CAPSULE, ShapeKind.ELLIPSOID)
"""Closed shapes that their size describes."""


class ShapeSizes:
    """How k primitives read their sizes, which are ``Shape.size`` filled up to three numbers, (n, k, 3).

    Attributes:
        is_read: Which of the three numbers each shape reads, (k, 3) bool.
    """

    def __init__(self, names: Sequence[str], kinds: Sequence[ShapeKind], device: torch.device) -> None:
        """Notes the kinds of shapes, which ``names`` name in the error if one has no such size.

        Raises:
            ValueError: A kind is not one of PRIMITIVES.
        """
        for name, kind in zip(names, kinds, strict=True):
            if kind not in PRIMITIVES:
                known = ", ".join(one.name.lower() for one in PRIMITIVES)
                raise ValueError(f"{name} is a {kind.name.lower()}; only these have sizes that can be set: {known}")

        def among(*some: ShapeKind) -> torch.Tensor:
            return torch.tensor([kind in some for kind in kinds], dtype=torch.bool, device=device)

        widths = torch.tensor([len(SIZE_NAMES[kind]) for kind in kinds], device=device)
        self.is_read = torch.arange(3, device=device) < widths[:, None]
        self._has_half_extents = among(ShapeKind.BOX, ShapeKind.ELLIPSOID)
        self._is_sphere, self._is_capsule = among(ShapeKind.SPHERE), among(ShapeKind.CAPSULE)
        self._has_no_corner = among(ShapeKind.SPHERE, ShapeKind.ELLIPSOID)

    def read(self, sizes: torch.Tensor) -> torch.Tensor:
        """Sizes with 0 where a number is not read."""
        return torch.where(self.is_read, sizes, 0.0)

    def are_valid(self, sizes: torch.Tensor) -> torch.Tensor:
        """Whether every number that is read is positive and finite, one bool."""
        return (~self.is_read | ((sizes > 0.0) & sizes.isfinite())).all()

    def half_extents(self, sizes: torch.Tensor) -> torch.Tensor:
        """Half extents of the boxes that hold the shapes in their own frames, metres, (n, k, 3)."""
        first, second, third = sizes.unbind(-1)
        half_length = torch.where(self._is_capsule, first + second, torch.where(self._is_sphere, first, second))
        y = torch.where(self._has_half_extents, second, first)
        return torch.stack((first, y, torch.where(self._has_half_extents, third, half_length)), -1)

    def bounding_radii(self, sizes: torch.Tensor) -> torch.Tensor:
        """``Shape.bounding_radius`` of shapes with sizes as ``read`` gives them, metres, (n, k)."""
        cornered = torch.where(self._is_capsule, sizes.sum(-1), torch.linalg.vector_norm(sizes, dim=-1))
        return torch.where(self._has_no_corner, sizes.amax(-1), cornered)
