"""Rotations and poses in kernels. Quaternions arrive as (w, x, y, z), of any norm; Warp's own are (x, y, z, w)."""

import warp as wp

wp.set_module_options({"enable_backward": False})

NOTHING = wp.constant(wp.float32(1.0e-9))


@wp.func
def to_quat(wxyz: wp.vec4):
    return wp.normalize(wp.quat(wxyz[1], wxyz[2], wxyz[3], wxyz[0]))


@wp.func
def to_quatd(wxyz: wp.vec4d):
    return wp.normalize(wp.quatd(wxyz[1], wxyz[2], wxyz[3], wxyz[0]))


@wp.func
def is_pose(p: wp.vec3d, q: wp.vec4d):
    """Tell whether a position and an orientation are finite and the orientation is one."""
    norm = wp.dot(q, q)
    away = wp.dot(p, p)
    return norm > wp.float64(1.0e-12) and norm < wp.float64(1.0e12) and away < wp.float64(1.0e30)


@wp.func
def to_pose(p: wp.vec3d, q: wp.vec4d):
    """The pose with its orientation (w, x, y, z) normalised; a norm that is 1 but for rounding needs no square root."""
    square = wp.dot(q, q)
    scale = wp.float64(1.5) - wp.float64(0.5) * square
    if wp.abs(square - wp.float64(1.0)) > wp.float64(1.0e-6):
        scale = wp.float64(1.0) / wp.sqrt(square)
    return wp.transformation(p, wp.quatd(scale * q[1], scale * q[2], scale * q[3], scale * q[0]))


@wp.func
def turn_of(pose: wp.transformd):
    """Rotation matrix of a pose."""
    return wp.mat33(wp.quat_to_matrix(wp.transform_get_rotation(pose)))


@wp.func
def flush_denormals(v: wp.vec3):
    """``v`` without parts so small that products of two would be denormal, on which a CPU is a hundred times slower."""
    return wp.vec3(
        wp.where(wp.abs(v[0]) < NOTHING, 0.0, v[0]),
        wp.where(wp.abs(v[1]) < NOTHING, 0.0, v[1]),
        wp.where(wp.abs(v[2]) < NOTHING, 0.0, v[2]),
    )


@wp.func
def axes_of(pose: wp.transformd):
    """The axes of a pose in rows."""
    turn = wp.mat33(wp.quat_to_matrix(wp.transform_get_rotation(pose)))
    return wp.matrix_from_rows(
        flush_denormals(wp.vec3(turn[0, 0], turn[1, 0], turn[2, 0])),
        flush_denormals(wp.vec3(turn[0, 1], turn[1, 1], turn[2, 1])),
        flush_denormals(wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])),
    )
