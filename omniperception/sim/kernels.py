"""Warp kernels beside the physics of MuJoCo Warp."""

import warp as wp


@wp.kernel(enable_backward=False)
def move_kinematic(step: int, first: int, path: wp.array3d[wp.vec3], mocap_pos_out: wp.array2d[wp.vec3]):
    env, body = wp.tid()
    mocap_pos_out[env, first + body] = path[env, step, body]


@wp.kernel(enable_backward=False)
def turn_kinematic(step: int, first: int, path: wp.array3d[wp.quat], mocap_quat_out: wp.array2d[wp.quat]):
    env, body = wp.tid()
    mocap_quat_out[env, first + body] = path[env, step, body]


@wp.kernel(enable_backward=False)
def record(step: int, values: wp.array2d[float], out: wp.array3d[float]):
    env, k = wp.tid()
    out[env, step, k] = values[env, k]
