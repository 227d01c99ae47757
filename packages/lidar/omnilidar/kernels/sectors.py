"""Nearest hits by azimuth sector."""

import warp as wp

from .geometry import PI
from .rotations import to_quat


@wp.func
def without_yaw(base_quat: wp.vec4):
    """The turn from the world to the base's yaw-aligned frame."""
    forward = wp.quat_rotate(to_quat(base_quat), wp.vec3(1.0, 0.0, 0.0))
    return wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -wp.atan2(forward[1], forward[0]))


@wp.func
def levelled(base_quat: wp.vec4):
    """The base's orientation without its yaw."""
    return without_yaw(base_quat) * to_quat(base_quat)


@wp.func
def bearing_in_sectors(x: float, y: float, num_sectors: int) -> float:
    """Azimuth from -pi on, in widths of a sector."""
    return (wp.atan2(y, x) + PI) * float(num_sectors) / (2.0 * PI)


@wp.func
def sector_at(bearing: float, num_sectors: int) -> int:
    """Sector of a bearing in widths of a sector."""
    return wp.clamp(int(bearing), 0, num_sectors - 1)


@wp.func
def sector_of(x: float, y: float, num_sectors: int) -> int:
    """Azimuth sector; sector 0 starts at -pi."""
    return sector_at(bearing_in_sectors(x, y, num_sectors), num_sectors)


@wp.kernel(module="unique", enable_backward=False)
def sector_minima(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    class_id: wp.array2d(dtype=wp.int32),
    body_pos: wp.array2d(dtype=wp.vec3),
    body_quat: wp.array2d(dtype=wp.vec4),
    base: int,
    carrier: int,
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    wanted_class: int,
    num_lanes: int,
    # in and out
    distances: wp.array2d(dtype=wp.float32),
):
    """Nearest horizontal distance of one environment's hits of a class, per azimuth sector.

    The lanes share an environment's rays.
    """
    thread, lane = wp.tid()
    env = thread + env_offset
    num_sectors = distances.shape[1]
    unturn = without_yaw(body_quat[env, base])
    level = unturn * to_quat(body_quat[env, carrier])
    offset = wp.quat_rotate(level, mount_pos)
    if carrier != base:
        offset += wp.quat_rotate(unturn, body_pos[env, carrier] - body_pos[env, base])
    turn = wp.quat_to_matrix(level * to_quat(mount_quat))
    for ray in range(lane, ranges.shape[1], num_lanes):
        if class_id[env, ray] == wanted_class:
            p = offset + ranges[env, ray] * (turn * directions[env, ray])
            wp.atomic_min(distances, env, sector_of(p[0], p[1], num_sectors), wp.sqrt(p[0] * p[0] + p[1] * p[1]))
