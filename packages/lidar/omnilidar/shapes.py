"""Shapes that rays can hit, described with MuJoCo's size conventions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from .heightfield import HeightField
from .meshes import TriangleMesh


class ShapeKind(IntEnum):
    """Kinds of shapes; the values are what the kernels branch on."""

    PLANE = 0
    BOX = 1
    SPHERE = 2
    CYLINDER = 3
    CAPSULE = 4
    ELLIPSOID = 5
    MESH = 6
    HEIGHTFIELD = 7
    DEFORMABLE = 8


SIZE_NAMES = {
    ShapeKind.PLANE: ("half_x", "half_y"),
    ShapeKind.BOX: ("half_x", "half_y", "half_z"),
    ShapeKind.SPHERE: ("radius",),
    ShapeKind.CYLINDER: ("radius", "half_length"),
    ShapeKind.CAPSULE: ("radius", "half_length"),
    ShapeKind.ELLIPSOID: ("half_x", "half_y", "half_z"),
    ShapeKind.MESH: (),
    ShapeKind.HEIGHTFIELD: (),
    ShapeKind.DEFORMABLE: (),
}
ASSET_TYPES = {
    ShapeKind.MESH: TriangleMesh,
    ShapeKind.HEIGHTFIELD: HeightField,
    ShapeKind.DEFORMABLE: TriangleMesh,
}


@dataclass(frozen=True)
class Shape:
    """One shape, carried by a moving body or fixed in its environment.

    Attributes:
        kind: What the shape is.
        size: Metres. Sphere ``(radius,)``; cylinder and capsule ``(radius, half_length)`` along the local z
            axis; box and ellipsoid half extents; plane ``()`` or ``(half_x, half_y)``, of which 0 is infinite, with its
            normal along the local +z axis; the others ``()``. ``RayScene.set_sizes`` changes it by environment.
        body: Index of the moving body that carries the shape; -1 is fixed in the environment's frame.
        pos: Position in that body's frame, metres.
        quat: Orientation in that body's frame, (w, x, y, z), unit length.
        class_id: What a hit on this shape is reported as, >= 0.
        asset: The ``TriangleMesh`` of a mesh (rigid) or a deformable (at rest), the ``HeightField`` of a height field.
            Shapes may share one; it is uploaded once, or once for each deformable. Triangles that have no area at
            rest are no part of a deformable.
    """

    kind: ShapeKind
    size: tuple[float, ...] = ()
    body: int = -1
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    class_id: int = 0
    asset: TriangleMesh | HeightField | None = None

    def __post_init__(self) -> None:
        kind = _as_kind(self.kind)
        object.__setattr__(self, "kind", kind)
        names = SIZE_NAMES[kind]
        if kind == ShapeKind.PLANE and len(self.size) == 0:
            object.__setattr__(self, "size", (0.0, 0.0))
        for field, length in (("size", len(names)), ("pos", 3), ("quat", 4)):
            object.__setattr__(self, field, finite_tuple(f"shape.{field}", getattr(self, field), length, names))
        if kind == ShapeKind.PLANE:
            if any(value < 0.0 for value in self.size):
                raise ValueError(f"shape.size={self.size} of a plane must be >= 0, of which 0 is infinite: {names}")
        elif any(value <= 0.0 for value in self.size):
            raise ValueError(f"shape.size={self.size} of a {kind.name.lower()} must be positive: {names}")
        norm = math.hypot(*self.quat)
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"shape.quat={self.quat} must be a unit quaternion (w, x, y, z); its norm is {norm:.6g}")
        for field, least, why in (("body", -1, "-1 is a fixed shape"), ("class_id", 0, "-1 is reserved for misses")):
            value = getattr(self, field)
            if not hasattr(value, "__index__") or value < least:
                raise ValueError(f"shape.{field}={value} must be a whole number >= {least}; {why}")
        self._check_asset()

    def _check_asset(self) -> None:
        wanted = ASSET_TYPES.get(self.kind)
        given = type(self.asset).__name__
        if wanted is None and self.asset is not None:
            raise ValueError(f"shape.asset={given} of a {self.kind.name.lower()} must be None: its size says it all")
        if wanted is not None and not isinstance(self.asset, wanted):
            raise ValueError(f"shape.asset={given} of a {self.kind.name.lower()} must be a {wanted.__name__}")

    @property
    def extents(self) -> tuple[float, float, float]:
        """Size as the kernels read it: for a mesh or a height field, half of a box around ``pos`` that holds it."""
        if self.kind in (ShapeKind.MESH, ShapeKind.HEIGHTFIELD):
            assert self.asset is not None
            return self.asset.half_extents
        x, y, z = (*self.size, 0.0, 0.0, 0.0)[:3]
        return x, y, z

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around ``pos`` that holds the shape, metres; infinite for a plane or a deformable."""
        if self.kind in (ShapeKind.PLANE, ShapeKind.DEFORMABLE):
            return math.inf
        if self.kind in (ShapeKind.BOX, ShapeKind.CYLINDER):
            return math.hypot(*self.size)
        if self.kind == ShapeKind.CAPSULE:
            return sum(self.size)
        if self.kind in (ShapeKind.SPHERE, ShapeKind.ELLIPSOID):
            return max(self.size)
        assert self.asset is not None
        return self.asset.radius


def finite_tuple(key: str, value: Sequence[float], length: int, names: Sequence[str] = ()) -> tuple[float, ...]:
    """``value`` as a tuple of ``length`` finite floats, or a ValueError that names ``key``."""
    try:
        result = tuple(float(item) for item in value)
    except TypeError:
        raise ValueError(f"{key}={value} must be {length} numbers") from None
    if len(result) != length:
        hint = f" {tuple(names)}" if key.endswith("size") else ""
        raise ValueError(f"{key}={result} must have {length} values{hint}, got {len(result)}")
    if not all(math.isfinite(item) for item in result):
        raise ValueError(f"{key}={result} must be finite")
    return result


def _as_kind(kind: int) -> ShapeKind:
    try:
        return ShapeKind(kind)
    except ValueError:
        known = ", ".join(item.name for item in ShapeKind)
        raise ValueError(f"shape.kind={kind!r} must be one of ShapeKind: {known}") from None
