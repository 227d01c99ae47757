"""Warp kernels that look up the height of the ground, one task per environment, one source for all devices."""

from functools import cache

import warp as wp

wp.set_module_options({"enable_backward": False})

_FARTHEST = wp.constant(wp.float64(1.0e6))
"""Cells from an environment's origin beyond which a point is as far away as it can be."""


@wp.struct
class Surface:
    """The height field and where each environment's frame lies on it; see `Ground`."""

    heights: wp.array(dtype=wp.float32)  # (rows * cols,) m, row by row
    rows: int
    cols: int
    cell: wp.float64  # m between two points of the grid
    middle: wp.array2d(dtype=wp.int64)  # (num_envs, 2) column and row of the point at an environment's origin
    level: wp.array(dtype=wp.float32)  # (num_envs,) height there, m


@wp.func
def height_below(surface: Surface, env: int, x: wp.float64, y: wp.float64):
    """Height (m) at (x, y) in an environment's frame; the diagonal of a cell's triangles is from (0, 0) to (1, 1)."""
    grid_x = wp.clamp(x / surface.cell, -_FARTHEST, _FARTHEST)
    grid_y = wp.clamp(y / surface.cell, -_FARTHEST, _FARTHEST)
    middle_x = int(surface.middle[env, 0])
    middle_y = int(surface.middle[env, 1])
    col = wp.clamp(int(wp.floor(grid_x)) + middle_x, 0, surface.cols - 2)
    row = wp.clamp(int(wp.floor(grid_y)) + middle_y, 0, surface.rows - 2)
    u = wp.clamp(grid_x - wp.float64(col - middle_x), wp.float64(0.0), wp.float64(1.0))
    v = wp.clamp(grid_y - wp.float64(row - middle_y), wp.float64(0.0), wp.float64(1.0))
    low = row * surface.cols + col
    corner = low + wp.where(u >= v, 1, surface.cols)
    h_low = wp.float64(surface.heights[low])
    h_corner = wp.float64(surface.heights[corner])
    h_high = wp.float64(surface.heights[low + surface.cols + 1])
    return (
        h_low + wp.max(u, v) * (h_corner - h_low) + wp.min(u, v) * (h_high - h_corner) - wp.float64(surface.level[env])
    )


@wp.func
def height_beside(surface: Surface, env: int, base_pos: wp.array2d(dtype=wp.float32), turn: wp.vec2d, offset: wp.vec2):
    """Height (m) at ``offset`` in the yaw-aligned frame of a base whose heading has cosine and sine ``turn``."""
    x = wp.float64(offset[0])
    y = wp.float64(offset[1])
    at_x = wp.float64(base_pos[env, 0]) + turn[0] * x - turn[1] * y
    at_y = wp.float64(base_pos[env, 1]) + turn[1] * x + turn[0] * y
    return height_below(surface, env, at_x, at_y)


@cache
def heights_kernel(real: type) -> wp.Kernel:
    """The kernel for points in ``wp.float32`` or ``wp.float64``; it computes in float64."""
    vec2 = wp.types.vector(2, real)

    @wp.kernel(module="unique", enable_backward=False)
    def heights_at(
        env_offset: int,
        surface: Surface,
        env_ids: wp.array(dtype=wp.int64),
        points: wp.array2d(dtype=vec2),
        # out
        height_out: wp.array2d(dtype=real),
    ):
        """Heights at the points of one environment."""
        i = wp.tid() + env_offset
        env = int(env_ids[i])
        for k in range(points.shape[1]):
            p = points[i, k]
            height_out[i, k] = real(height_below(surface, env, wp.float64(p[0]), wp.float64(p[1])))

    return heights_at


@wp.kernel(module="unique", enable_backward=False)
def base_heights(
    env_offset: int,
    surface: Surface,
    base_pos: wp.array2d(dtype=wp.float32),
    yaw: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.vec2),
    # out
    height_out: wp.array(dtype=wp.float32),
):
    """Height of the base of one environment above the mean of the ground at some points around it."""
    env = wp.tid() + env_offset
    turn = wp.vec2d(wp.float64(wp.cos(yaw[env])), wp.float64(wp.sin(yaw[env])))
    total = wp.float64(0.0)
    for k in range(offsets.shape[0]):
        total += height_beside(surface, env, base_pos, turn, offsets[k])
    mean = total / wp.float64(offsets.shape[0])
    height_out[env] = float(wp.float64(base_pos[env, 2]) - mean)


@wp.kernel(module="unique", enable_backward=False)
def heights_around(
    env_offset: int,
    surface: Surface,
    base_pos: wp.array2d(dtype=wp.float32),
    yaw: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.vec2),
    bound: float,
    # out
    height_out: wp.array2d(dtype=wp.float32),
):
    """Height of the base of one environment above the ground at each of some points around it, within +-bound."""
    env = wp.tid() + env_offset
    turn = wp.vec2d(wp.float64(wp.cos(yaw[env])), wp.float64(wp.sin(yaw[env])))
    for k in range(offsets.shape[0]):
        below = height_beside(surface, env, base_pos, turn, offsets[k])
        height_out[env, k] = wp.clamp(float(wp.float64(base_pos[env, 2]) - below), -bound, bound)


@cache
def lift_kernel(real: type) -> wp.Kernel:
    """The kernel for obstacles in ``wp.float32`` or ``wp.float64``; it computes in float64."""
    vec3 = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False)
    def lift(
        env_offset: int,
        surface: Surface,
        above: wp.array2d(dtype=real),
        active: wp.array2d(dtype=wp.bool),
        parked: real,
        # in and out
        path: wp.array3d(dtype=vec3),
    ):
        """Lifts one environment's obstacles, by step, ``above`` the ground; the others are parked at ``parked``."""
        env = wp.tid() + env_offset
        for step in range(path.shape[1]):
            for k in range(path.shape[2]):
                p = path[env, step, k]
                z = parked
                if active[env, k]:
                    z = above[env, k] + real(height_below(surface, env, wp.float64(p[0]), wp.float64(p[1])))
                path[env, step, k] = vec3(p[0], p[1], z)

    return lift
