"""Rays through triangle meshes: a descent of a tree of boxes, four at a time."""

from pathlib import Path

import warp as wp

from ..native import constant, function_body

wp.set_module_options({"enable_backward": False})

HEADER = Path(__file__).with_name("mesh_descend.h")
STACK_SIZE = constant(HEADER, "stack_size")
"""Nodes that a descent can put off; ``meshes`` builds no tree that needs more."""


@wp.struct
class MeshPart:
    """Place of the tree of one shape's mesh in the arrays of its scene; strides are those of environments."""

    first_child: int
    first_node: int
    node_stride: int
    first_leaf: int
    leaf_stride: int


@wp.func_native(function_body(HEADER))
def descend(
    bounds: wp.array2d(dtype=wp.vec4),
    child: wp.array(dtype=wp.vec4i),
    triangles: wp.array2d(dtype=wp.vec4),
    first_child: int,
    first_node: int,
    first_leaf: int,
    o: wp.vec3,
    d: wp.vec3,
    inv: wp.vec3,
    limit: float,
) -> wp.vec3d:
    """(distance, face, sine of the angle of incidence) of the nearest triangle before ``limit`` along d from o.

    Infinite, -1 and 0 if there is none.
    """
    ...


@wp.func
def slab_inverse(x: float):
    """1 / x, finite: so small a part of a unit vector moves no point."""
    if wp.abs(x) < 1.0e-12:
        return wp.where(x < 0.0, -1.0e12, 1.0e12)
    return 1.0 / x


@wp.func
def corner_of(triangles: wp.array2d(dtype=wp.vec4), first_leaf: int, face: int, corner: int):
    leaf = first_leaf + face / 4
    lane = face % 4
    x = triangles[leaf, 3 * corner]
    y = triangles[leaf, 3 * corner + 1]
    z = triangles[leaf, 3 * corner + 2]
    return wp.vec3d(wp.float64(x[lane]), wp.float64(y[lane]), wp.float64(z[lane]))


@wp.func
def plane_through(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, o: wp.vec3d, d: wp.vec3d, t: wp.float64):
    """Distance at which the ray crosses the plane of a triangle that float32 hit near ``t``, within its corners."""
    n = wp.normalize(wp.cross(b - a, c - a))
    sine = wp.dot(n, d)
    if wp.abs(sine) < wp.float64(1.0e-9):
        return t
    along_a = wp.dot(a - o, d)
    along_b = wp.dot(b - o, d)
    along_c = wp.dot(c - o, d)
    near = wp.max(wp.min(along_a, wp.min(along_b, along_c)), wp.float64(0.0))
    return wp.clamp(wp.dot(n, a - o) / sine, near, wp.max(near, wp.max(along_a, wp.max(along_b, along_c))))
