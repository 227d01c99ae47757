"""Exact intersections of rays with shapes, compiled for the kinds of shapes that a scene has."""

# ruff: noqa: UP018, SIM102  (in a kernel, int(0) and float(0) declare a variable that may change, and a branch on
# wp.static stands alone)

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import warp as wp

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
BOX = wp.constant(1)
SPHERE = wp.constant(2)
CYLINDER = wp.constant(3)
CAPSULE = wp.constant(4)
ELLIPSOID = wp.constant(5)

INF = wp.constant(wp.float32(math.inf))
PI = wp.constant(wp.float32(math.pi))
FAR = wp.constant(wp.float32(1.0e9))
PARALLEL = wp.constant(wp.float32(1.0e-12))
SLACK = wp.constant(wp.float32(1.0e-5))


@wp.struct
class Geometry:
    """What the shapes of a scene are, indexed by shape."""

    kind: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.vec3)
    radius: wp.array(dtype=wp.float32)
    class_id: wp.array(dtype=wp.int32)


@wp.struct
class Hit:
    """Where a ray meets a shape: distance, infinite for a miss, and which face of a mesh, -1 for other shapes."""

    t: wp.float32
    face: wp.int32


# --- frames -------------------------------------------------------------------------------------------------


@wp.func
def to_quat(wxyz: wp.vec4):
    return wp.normalize(wp.quat(wxyz[1], wxyz[2], wxyz[3], wxyz[0]))


@wp.func
def away_from_zero(x: float):
    if wp.abs(x) < PARALLEL:
        return wp.where(x < 0.0, -PARALLEL, PARALLEL)
    return x


# --- intersections: a ray from the frame's origin along unit d with a shape centred at c --------------------
# ``axes`` holds the shape's x, y and z axis in its rows. A closed shape is convex, so a line meets it between
# t_in and t_out; a ray that starts inside hits the exit surface, as in mj_ray.


@wp.func
def first_crossing(t_in: float, t_out: float):
    if t_in > t_out or t_out < 0.0:
        return INF
    return wp.where(t_in >= 0.0, t_in, t_out)


@wp.func
def meet_plane(d: wp.vec3, c: wp.vec3, axes: wp.mat33):
    """Hit from the side of the normal only."""
    slope = axes[2, 0] * d[0] + axes[2, 1] * d[1] + axes[2, 2] * d[2]
    height = axes[2, 0] * c[0] + axes[2, 1] * c[1] + axes[2, 2] * c[2]
    if slope > -PARALLEL or height > 0.0:
        return INF
    return height / slope


@wp.func
def meet_sphere(d: wp.vec3, c: wp.vec3, radius: float):
    t_mid = wp.dot(d, c)
    across = c - t_mid * d
    disc = radius * radius - wp.dot(across, across)
    if disc < 0.0:
        return INF
    half = wp.sqrt(disc)
    return first_crossing(t_mid - half, t_mid + half)


@wp.func
def meet_box(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    direction = axes * d
    centre = axes * c
    t_in = -FAR
    t_out = FAR
    for i in range(3):
        inv = 1.0 / away_from_zero(direction[i])
        mid = centre[i] * inv
        half = size[i] * wp.abs(inv)
        t_in = wp.max(t_in, mid - half)
        t_out = wp.min(t_out, mid + half)
    return first_crossing(t_in, t_out)


@wp.func
def meet_ellipsoid(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    direction = wp.cw_div(axes * d, size)
    centre = wp.cw_div(axes * c, size)
    dd = wp.dot(direction, direction)
    t_mid = wp.dot(centre, direction) / dd
    across = centre - t_mid * direction
    disc = 1.0 - wp.dot(across, across)
    if disc < 0.0:
        return INF
    half = wp.sqrt(disc / dd)
    return first_crossing(t_mid - half, t_mid + half)


@wp.func
def meet_tube(d: wp.vec3, c: wp.vec3, axis: wp.vec3, radius: float):
    """t_in and t_out of the infinite cylinder around ``axis``; t_in > t_out if the line misses it."""
    across = wp.cross(d, axis)
    moment = wp.cross(axis, c)
    a = wp.dot(across, across)
    offset = wp.dot(d, moment)
    disc = radius * radius * a - offset * offset
    if a < PARALLEL:
        inside = wp.dot(moment, moment) <= radius * radius
        return wp.where(inside, wp.vec2(-FAR, FAR), wp.vec2(FAR, -FAR))
    if disc < 0.0:
        return wp.vec2(FAR, -FAR)
    t_mid = -wp.dot(across, moment) / a
    half = wp.sqrt(disc) / a
    return wp.vec2(t_mid - half, t_mid + half)


@wp.func
def meet_cylinder(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    axis = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    tube = meet_tube(d, c, axis, size[0])
    if tube[0] > tube[1]:
        return INF
    inv = 1.0 / away_from_zero(wp.dot(d, axis))
    mid = wp.dot(c, axis) * inv
    half = size[1] * wp.abs(inv)
    return first_crossing(wp.max(tube[0], mid - half), wp.min(tube[1], mid + half))


@wp.func
def cap_half_chord(d: wp.vec3, c: wp.vec3, radius: float):
    """Half the chord that the line cuts from a sphere; negative if it misses."""
    across = c - wp.dot(d, c) * d
    disc = radius * radius - wp.dot(across, across)
    if disc < 0.0:
        return float(-1.0)
    return wp.sqrt(disc)


@wp.func
def meet_capsule(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    axis = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    tube = meet_tube(d, c, axis, size[0])
    if tube[0] > tube[1]:
        return INF
    slope = wp.dot(d, axis)
    height = wp.dot(c, axis)
    t_in = tube[0]
    t_out = tube[1]
    z_in = t_in * slope - height
    z_out = t_out * slope - height
    if wp.abs(z_in) > size[1]:
        cap = c + wp.clamp(z_in, -size[1], size[1]) * axis
        half = cap_half_chord(d, cap, size[0])
        if half < 0.0:
            return INF
        t_in = wp.dot(d, cap) - half
    if wp.abs(z_out) > size[1]:
        cap_out = c + wp.clamp(z_out, -size[1], size[1]) * axis
        half_out = cap_half_chord(d, cap_out, size[0])
        if half_out < 0.0:
            return INF
        t_out = wp.dot(d, cap_out) + half_out
    return first_crossing(t_in, t_out)


@wp.func
def outward_normal(kind: int, point: wp.vec3, size: wp.vec3):
    """Unit normal of the surface next to ``point``, both in the shape's own frame."""
    if kind == PLANE:
        return wp.vec3(0.0, 0.0, 1.0)
    if kind == SPHERE:
        return wp.normalize(point)
    if kind == ELLIPSOID:
        return wp.normalize(wp.cw_div(point, wp.cw_mul(size, size)))
    if kind == CAPSULE:
        return wp.normalize(point - wp.vec3(0.0, 0.0, wp.clamp(point[2], -size[1], size[1])))
    if kind == CYLINDER:
        rho = wp.sqrt(point[0] * point[0] + point[1] * point[1])
        if wp.abs(wp.abs(point[2]) - size[1]) < wp.abs(rho - size[0]):
            return wp.vec3(0.0, 0.0, wp.sign(point[2]))
        return wp.normalize(wp.vec3(point[0], point[1], 0.0))
    gap = wp.vec3(
        wp.abs(wp.abs(point[0]) - size[0]),
        wp.abs(wp.abs(point[1]) - size[1]),
        wp.abs(wp.abs(point[2]) - size[2]),
    )
    if gap[0] <= gap[1] and gap[0] <= gap[2]:
        return wp.vec3(wp.sign(point[0]), 0.0, 0.0)
    if gap[1] <= gap[2]:
        return wp.vec3(0.0, wp.sign(point[1]), 0.0)
    return wp.vec3(0.0, 0.0, wp.sign(point[2]))


@wp.func
def distance_to_shape(kind: int, c: wp.vec3, axes: wp.mat33, size: wp.vec3, radius: float):
    """A lower bound (exact except for ellipsoids) of the origin's distance to the shape; 0 inside."""
    p = axes * c
    if kind == PLANE:
        return wp.max(-p[2], 0.0)
    if kind == BOX:
        away = wp.vec3(
            wp.max(wp.abs(p[0]) - size[0], 0.0),
            wp.max(wp.abs(p[1]) - size[1], 0.0),
            wp.max(wp.abs(p[2]) - size[2], 0.0),
        )
        return wp.length(away)
    if kind == CAPSULE:
        beyond = wp.max(wp.abs(p[2]) - size[1], 0.0)
        return wp.max(wp.length(wp.vec3(p[0], p[1], beyond)) - size[0], 0.0)
    if kind == CYLINDER:
        out = wp.max(wp.sqrt(p[0] * p[0] + p[1] * p[1]) - size[0], 0.0)
        over = wp.max(wp.abs(p[2]) - size[1], 0.0)
        return wp.sqrt(out * out + over * over)
    return wp.max(wp.length(c) - radius, 0.0)


# --- one function for all kinds of a scene --------------------------------------------------------------------


@dataclass(frozen=True)
class ShapeFunctions:
    """Warp functions over the shapes of a scene.

    Attributes:
        meet: (geometry, shape, env, d, c, axes, best) -> Hit; the nearest hit before ``best`` along unit d from the
            origin, for a shape centred at c whose axes are the rows of ``axes``.
        normal: (geometry, shape, env, face, point) -> outward unit normal next to ``point``, in the shape's frame.
    """

    meet: wp.Function
    normal: wp.Function


def shape_functions(kinds: Iterable[int]) -> ShapeFunctions:
    """The functions for scenes that hold these kinds only; what serves other kinds is not compiled."""
    return _shape_functions(frozenset(int(kind) for kind in kinds))


@cache
def _shape_functions(kinds: frozenset[int]) -> ShapeFunctions:
    has_plane, has_box, has_sphere = PLANE in kinds, BOX in kinds, SPHERE in kinds
    has_cylinder, has_capsule, has_ellipsoid = CYLINDER in kinds, CAPSULE in kinds, ELLIPSOID in kinds

    @wp.func
    def meet(geometry: Geometry, shape: int, env: int, d: wp.vec3, c: wp.vec3, axes: wp.mat33, best: float):
        kind = geometry.kind[shape]
        t = INF
        if wp.static(has_plane):
            if kind == PLANE:
                t = meet_plane(d, c, axes)
        if wp.static(has_capsule):
            if kind == CAPSULE:
                t = meet_capsule(d, c, axes, geometry.size[shape])
        if wp.static(has_sphere):
            if kind == SPHERE:
                t = meet_sphere(d, c, geometry.size[shape][0])
        if wp.static(has_box):
            if kind == BOX:
                t = meet_box(d, c, axes, geometry.size[shape])
        if wp.static(has_cylinder):
            if kind == CYLINDER:
                t = meet_cylinder(d, c, axes, geometry.size[shape])
        if wp.static(has_ellipsoid):
            if kind == ELLIPSOID:
                t = meet_ellipsoid(d, c, axes, geometry.size[shape])
        hit = Hit()
        hit.t = t
        hit.face = -1
        return hit

    @wp.func
    def normal(geometry: Geometry, shape: int, env: int, face: int, point: wp.vec3):
        return outward_normal(geometry.kind[shape], point, geometry.size[shape])

    return ShapeFunctions(meet, normal)
