"""Nearest hits by azimuth sector."""

import warp as wp

from .geometry import PI, to_quat


@wp.kernel(module="unique", enable_backward=False)
def sector_minima(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    class_id: wp.array2d(dtype=wp.int32),
    base_quat: wp.array2d(dtype=wp.vec4),
    base: int,
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    wanted_class: int,
    max_distance: float,
    # out
    distances_out: wp.array2d(dtype=wp.float32),
):
    """Nearest horizontal distance of one environment's hits of a class, per azimuth sector."""
    env = wp.tid() + env_offset
    num_sectors = distances_out.shape[1]
    for k in range(num_sectors):
        distances_out[env, k] = max_distance
    q_base = to_quat(base_quat[env, base])
    forward = wp.quat_rotate(q_base, wp.vec3(1.0, 0.0, 0.0))
    yaw = wp.atan2(forward[1], forward[0])
    level = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -yaw) * q_base
    offset = wp.quat_rotate(level, mount_pos)
    turn = wp.quat_to_matrix(level * to_quat(mount_quat))
    for ray in range(ranges.shape[1]):
        if class_id[env, ray] == wanted_class:
            p = offset + ranges[env, ray] * (turn * directions[env, ray])
            distance = wp.sqrt(p[0] * p[0] + p[1] * p[1])
            sector = int(wp.floor((wp.atan2(p[1], p[0]) + PI) * float(num_sectors) / (2.0 * PI)))
            if sector >= num_sectors:
                sector = 0
            sector = wp.max(sector, 0)
            distances_out[env, sector] = wp.min(distances_out[env, sector], distance)
