"""Shapes in a viewer's frame, nearest first."""

import warp as wp

from .geometry import INF, PLANE, SLACK, distance_to_shape, to_quat

wp.set_module_options({"enable_backward": False})


@wp.kernel(module="unique", enable_backward=False)
def place_shapes(
    env_offset: int,
    # scene
    body_pos: wp.array2d(dtype=wp.vec3),
    body_quat: wp.array2d(dtype=wp.vec4),
    shape_kind: wp.array(dtype=wp.int32),
    shape_body: wp.array(dtype=wp.int32),
    shape_pos: wp.array(dtype=wp.vec3),
    shape_quat: wp.array(dtype=wp.vec4),
    shape_size: wp.array(dtype=wp.vec3),
    shape_radius: wp.array(dtype=wp.float32),
    # view
    viewed: wp.array(dtype=wp.int32),
    num_viewed: int,
    view_body: int,
    view_pos: wp.vec3,
    view_quat: wp.vec4,
    cull: int,
    max_range: float,
    elevation_min: float,
    elevation_max: float,
    # out
    slot_bound_out: wp.array2d(dtype=wp.vec4),
    slot_near_out: wp.array2d(dtype=wp.float32),
    slot_shape_out: wp.array2d(dtype=wp.int32),
    slot_axes_out: wp.array2d(dtype=wp.mat33),
    num_slots_out: wp.array(dtype=wp.int32),
):
    """Expresses one environment's shapes in the viewer's frame, nearest first, without those out of reach."""
    env = wp.tid() + env_offset
    p_view = view_pos
    q_view = to_quat(view_quat)
    if view_body >= 0:
        q_carrier = to_quat(body_quat[env, view_body])
        p_view = body_pos[env, view_body] + wp.quat_rotate(q_carrier, view_pos)
        q_view = q_carrier * q_view
    count = wp.int32(0)
    for i in range(num_viewed):
        shape = viewed[i]
        body = shape_body[shape]
        p = shape_pos[shape]
        q = to_quat(shape_quat[shape])
        if body >= 0:
            q_body = to_quat(body_quat[env, body])
            p = body_pos[env, body] + wp.quat_rotate(q_body, p)
            q = q_body * q
        kind = shape_kind[shape]
        c = wp.quat_rotate_inv(q_view, p - p_view)
        axes = wp.transpose(wp.quat_to_matrix(wp.quat_inverse(q_view) * q))
        radius = shape_radius[shape]
        near = distance_to_shape(kind, c, axes, shape_size[shape], radius)
        distance = wp.length(c)
        threshold = -INF
        if distance > radius * (1.0 + SLACK):
            threshold = (distance - radius) * (distance + radius) * (1.0 - SLACK) - radius * radius * SLACK
        bound = wp.vec4(c[0], c[1], c[2], threshold)
        reachable = cull == 0 or near < max_range
        if cull != 0 and kind == PLANE:
            height = -wp.dot(c, wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2]))
            foot = -height * wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
            bound = wp.vec4(foot[0], foot[1], foot[2], 0.0)
            reachable = height >= 0.0 and near < max_range
        elif cull != 0 and distance > radius * (1.0 + SLACK):
            elevation = wp.asin(wp.clamp(c[2] / distance, -1.0, 1.0))
            spread = wp.asin(wp.clamp(radius / distance, 0.0, 1.0)) + 0.001
            if elevation + spread < elevation_min or elevation - spread > elevation_max:
                reachable = False
        if reachable:
            slot = count
            while slot > 0 and slot_near_out[env, wp.max(slot - 1, 0)] > near:
                slot_bound_out[env, slot] = slot_bound_out[env, slot - 1]
                slot_near_out[env, slot] = slot_near_out[env, slot - 1]
                slot_shape_out[env, slot] = slot_shape_out[env, slot - 1]
                slot_axes_out[env, slot] = slot_axes_out[env, slot - 1]
                slot -= 1
            slot_bound_out[env, slot] = bound
            slot_near_out[env, slot] = near
            slot_shape_out[env, slot] = shape
            slot_axes_out[env, slot] = axes
            count += 1
    num_slots_out[env] = count
