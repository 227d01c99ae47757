"""Intersections of rays with the shapes of a scene, of every kind."""

# ruff: noqa: SIM102, SIM109  (in a kernel, a branch on wp.static stands alone, and there is no 'in')

import math
from functools import cache

import warp as wp

from .heightfield import FieldPart, heightfield_normal, intersect_heightfield, refine_heightfield
from .intersections import intersections
from .mesh import MeshPart, corner_of, descend, plane_through, slab_inverse

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
BOX = wp.constant(1)
SPHERE = wp.constant(2)
CYLINDER = wp.constant(3)
CAPSULE = wp.constant(4)
ELLIPSOID = wp.constant(5)
MESH = wp.constant(6)
HEIGHTFIELD = wp.constant(7)
DEFORMABLE = wp.constant(8)

INF = wp.constant(wp.float32(math.inf))
PI = wp.constant(wp.float32(math.pi))
SLACK = wp.constant(wp.float32(1.0e-5))
REFINE = wp.constant(wp.float32(50.0))


@wp.struct
class Geometry:
    """Shapes of a scene, indexed by shape; the data of meshes and height fields follow one another.

    ``size``, the same in float64 and the bounding ``radius`` are each environment's own, (num_envs, S). ``body``
    carries the shape at ``pose``, -1 being the environment. ``part`` is a shape's place in ``mesh_part`` or
    ``field_part``. The tree of a mesh has boxes ``mesh_bounds`` (node, axis of lows then highs) of four children
    ``mesh_child``: a node if > 0, none if 0, leaf -1 - child if < 0. A leaf is four triangles ``mesh_triangle`` (leaf,
    3 * corner + axis). A height field's level is (first, columns) in ``field_extreme``, which holds lowest and highest
    heights; ``field_window`` is read by ``march_block``.
    """

    kind: wp.array(dtype=wp.int32)
    body: wp.array(dtype=wp.int32)
    pose: wp.array(dtype=wp.transformd)
    size: wp.array2d(dtype=wp.vec3)
    exact_size: wp.array2d(dtype=wp.vec3d)
    radius: wp.array2d(dtype=wp.float32)
    class_id: wp.array(dtype=wp.int32)
    part: wp.array(dtype=wp.int32)
    mesh_part: wp.array(dtype=MeshPart)
    mesh_bounds: wp.array2d(dtype=wp.vec4)
    mesh_child: wp.array(dtype=wp.vec4i)
    mesh_triangle: wp.array2d(dtype=wp.vec4)
    field_part: wp.array(dtype=FieldPart)
    field_height: wp.array(dtype=wp.float32)
    field_level: wp.array(dtype=wp.vec2i)
    field_extreme: wp.array(dtype=wp.vec2)
    field_window: wp.array(dtype=wp.vec4)


@wp.struct
class Hit:
    """Hit of a ray on a shape.

    Distance, infinite for a miss; which face of a mesh or height field, -1 for other shapes; sine of the angle between
    ray and surface, 0 where it is not known.
    """

    t: wp.float32
    face: wp.int32
    sin_incidence: wp.float32


# --- surfaces -----------------------------------------------------------------------------------------------


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
    """A lower bound of the origin's distance to the shape; 0 inside. Meshes and height fields count as their boxes."""
    if kind == DEFORMABLE:
        return 0.0
    p = axes * c
    if kind == PLANE:
        return wp.max(-p[2], 0.0)
    if kind == BOX or kind == MESH or kind == HEIGHTFIELD:
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


# --- shapes of any kind ---------------------------------------------------------------------------------------

hit_plane, hit_sphere, hit_box, hit_cylinder, hit_capsule, hit_ellipsoid = intersections(wp.float32)
exact_plane, exact_sphere, exact_box, exact_cylinder, exact_capsule, exact_ellipsoid = intersections(wp.float64)


@wp.func
def uncertain(hit: Hit, c: wp.vec3):
    """Tell whether rounding may have moved a hit on a shape centred at c by more than 1e-5 of its range plus 1e-5 m."""
    return hit.sin_incidence * (1.0 + hit.t) * REFINE < hit.t + wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2])


@cache
def shape_functions(mesh: bool, heightfield: bool) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Functions (intersect, refine, shape_normal) for scenes with or without meshes and height fields.

    Both are most of the code: with them in it, a scan of a scene that has none takes 15 % longer.
    """

    @wp.func
    def intersect(geometry: Geometry, shape: int, env: int, d: wp.vec3, c: wp.vec3, axes: wp.mat33, best: float):
        """The nearest hit before ``best`` along unit d from the origin on a shape centred at c with axes in rows."""
        kind = geometry.kind[shape]
        found = wp.vec2(INF, 0.0)
        face = wp.int32(-1)
        if kind == PLANE:
            found = hit_plane(d, c, axes, geometry.size[env, shape])
        elif kind == CAPSULE:
            found = hit_capsule(d, c, axes, geometry.size[env, shape])
        elif kind == SPHERE:
            found = hit_sphere(d, c, geometry.size[env, shape])
        elif kind == BOX:
            found = hit_box(d, c, axes, geometry.size[env, shape])
        elif kind == CYLINDER:
            found = hit_cylinder(d, c, axes, geometry.size[env, shape])
        elif kind == ELLIPSOID:
            found = hit_ellipsoid(d, c, axes, geometry.size[env, shape])
        if wp.static(heightfield):
            if kind == HEIGHTFIELD:
                on_field = intersect_heightfield(
                    geometry.field_part[geometry.part[shape]],
                    geometry.field_height,
                    geometry.field_level,
                    geometry.field_extreme,
                    -(axes * c),
                    axes * d,
                    best,
                )
                found = wp.vec2(on_field.t, on_field.sin_incidence)
                face = on_field.face
        if wp.static(mesh):
            if kind == MESH or kind == DEFORMABLE:
                part = geometry.mesh_part[geometry.part[shape]]
                direction = axes * d
                on_mesh = descend(
                    geometry.mesh_bounds,
                    geometry.mesh_child,
                    geometry.mesh_triangle,
                    part.first_child,
                    part.first_node + env * part.node_stride,
                    part.first_leaf + env * part.leaf_stride,
                    -(axes * c),
                    direction,
                    wp.vec3(slab_inverse(direction[0]), slab_inverse(direction[1]), slab_inverse(direction[2])),
                    best,
                )
                found = wp.vec2(float(on_mesh[0]), float(on_mesh[2]))
                face = int(on_mesh[1])
        return Hit(found[0], face, found[1])

    @wp.func
    def refine(geometry: Geometry, shape: int, env: int, face: int, d: wp.vec3d, pose: wp.transformd, t: float):
        """The distance t of a hit computed again in float64; ``pose`` is the shape's in the frame of the ray."""
        kind = geometry.kind[shape]
        q = wp.transform_get_rotation(pose)
        direction = wp.quat_rotate_inv(q, d)
        centre = wp.quat_rotate_inv(q, wp.transform_get_translation(pose))
        exact = wp.float64(t)
        own = wp.identity(n=3, dtype=wp.float64)
        size = geometry.exact_size[env, shape]
        if kind == PLANE:
            exact = exact_plane(direction, centre, own, size)[0]
        elif kind == CAPSULE:
            exact = exact_capsule(direction, centre, own, size)[0]
        elif kind == SPHERE:
            exact = exact_sphere(direction, centre, size)[0]
        elif kind == BOX:
            exact = exact_box(direction, centre, own, size)[0]
        elif kind == CYLINDER:
            exact = exact_cylinder(direction, centre, own, size)[0]
        elif kind == ELLIPSOID:
            exact = exact_ellipsoid(direction, centre, own, size)[0]
        if wp.static(heightfield):
            if kind == HEIGHTFIELD:
                field = geometry.field_part[geometry.part[shape]]
                exact = refine_heightfield(field, geometry.field_height, face, -centre, direction, exact)
        if wp.static(mesh):
            if kind == MESH or kind == DEFORMABLE:
                part = geometry.mesh_part[geometry.part[shape]]
                leaves = part.first_leaf + env * part.leaf_stride
                exact = plane_through(
                    corner_of(geometry.mesh_triangle, leaves, face, 0),
                    corner_of(geometry.mesh_triangle, leaves, face, 1),
                    corner_of(geometry.mesh_triangle, leaves, face, 2),
                    -centre,
                    direction,
                    exact,
                )
        if wp.isfinite(exact):
            return float(exact)
        return t

    @wp.func
    def shape_normal(geometry: Geometry, shape: int, env: int, face: int, point: wp.vec3):
        """Outward unit normal next to ``point``, both in the shape's frame."""
        kind = geometry.kind[shape]
        n = wp.vec3(0.0, 0.0, 1.0)
        if kind < MESH:
            n = outward_normal(kind, point, geometry.size[env, shape])
        if wp.static(heightfield):
            if kind == HEIGHTFIELD:
                n = heightfield_normal(geometry.field_part[geometry.part[shape]], geometry.field_height, face, point)
        if wp.static(mesh):
            if kind == MESH or kind == DEFORMABLE:
                part = geometry.mesh_part[geometry.part[shape]]
                leaves = part.first_leaf + env * part.leaf_stride
                a = corner_of(geometry.mesh_triangle, leaves, face, 0)
                b = corner_of(geometry.mesh_triangle, leaves, face, 1)
                c = corner_of(geometry.mesh_triangle, leaves, face, 2)
                n = wp.vec3(wp.normalize(wp.cross(b - a, c - a)))
        return n

    return intersect, refine, shape_normal
