"""Shapes in a viewer's frame, nearest first, or in their environment's, neighbours together."""

# ruff: noqa: UP018  (in a kernel, wp.int32(0) declares a variable that may change)

import math
from typing import Any

import warp as wp

from .geometry import INF, PLANE, SLACK, Geometry, distance_to_shape
from .rotations import NOTHING, axes_of, flush_denormals, is_pose, to_pose
from .slots import Slots, Viewpoint, pack_words

wp.set_module_options({"enable_backward": False})

GROUP_SIZE = 16
"""Slots that general rays pass by with one comparison."""

GROUP = wp.constant(GROUP_SIZE)
ROUNDING = wp.constant(wp.float32(1.0e-6))
FEW = wp.constant(24)
NUM_BUCKETS = wp.constant(64)
Buckets = wp.types.vector(length=64, dtype=wp.int32)
MARGIN = wp.constant(wp.float32(1.0e-3))
HALF_PI = wp.constant(wp.float32(0.5 * math.pi))


@wp.struct
class Limits:
    """Shapes that a viewer may see at all."""

    viewed: wp.array(dtype=wp.int32)  # indices of shapes
    num_viewed: int
    cull: bool  # whether shapes out of reach are left out; without it, neighbours stand together
    max_range: float
    elevation_min: float  # of rays, rad
    elevation_max: float


@wp.func
def _sort_into_buckets(
    env: int,
    count: int,
    near: wp.array2d(dtype=wp.float32),
    order: wp.array2d(dtype=wp.int32),
    spare: wp.array2d(dtype=wp.float32),
):
    """Sorts one environment's slots into buckets of equal width; returns how many the fullest bucket holds."""
    lowest = near[env, 0]
    highest = near[env, 0]
    for slot in range(count):
        spare[env, slot] = near[env, slot]
        lowest = wp.min(lowest, near[env, slot])
        highest = wp.max(highest, near[env, slot])
    scale = float(NUM_BUCKETS) / wp.max(highest - lowest, NOTHING)
    end = Buckets()
    for slot in range(count):
        bucket = wp.clamp(int(scale * (near[env, slot] - lowest)), 0, NUM_BUCKETS - 1)
        end[bucket] = end[bucket] + 1
    fullest = wp.int32(0)
    for bucket in range(NUM_BUCKETS):
        fullest = wp.max(fullest, end[bucket])
        if bucket > 0:
            end[bucket] = end[bucket] + end[bucket - 1]
    for i in range(count):
        slot = count - 1 - i
        bucket = wp.clamp(int(scale * (spare[env, slot] - lowest)), 0, NUM_BUCKETS - 1)
        rank = end[bucket] - 1
        end[bucket] = rank
        near[env, rank] = spare[env, slot]
        order[env, rank] = slot
    return fullest


@wp.func
def _sort_by_distance(
    env: int,
    count: int,
    near: wp.array2d(dtype=wp.float32),
    order: wp.array2d(dtype=wp.int32),
    spare: wp.array2d(dtype=wp.float32),
):
    """Sorts one environment's slots: many into buckets, then all by Shell's method as far as they may be misplaced."""
    misplaced = count
    if count > FEW:
        misplaced = _sort_into_buckets(env, count, near, order, spare)
    gap = wp.int32(1)
    while 4 * gap < misplaced:
        gap = 9 * gap // 4 + 1
    while gap > 0:
        for i in range(gap, count):
            distance = near[env, i]
            if near[env, i - gap] > distance:
                slot = order[env, i]
                j = int(i)
                while j >= gap and near[env, wp.max(j - gap, 0)] > distance:
                    near[env, j] = near[env, j - gap]
                    order[env, j] = order[env, j - gap]
                    j -= gap
                near[env, j] = distance
                order[env, j] = slot
        gap = 4 * gap // 9
    return 0


@wp.func
def _curve_position(p: wp.vec3):
    """Position along a Morton curve through the unit cube, exact in float32: points near each other have near ones."""
    code = wp.int32(0)
    for bit in range(8):
        for axis in range(3):
            cell = wp.clamp(int(p[axis] * 256.0), 0, 255)
            code = code | (((cell >> bit) & 1) << (3 * bit + axis))
    return float(code)


@wp.func
def _order_along_curve(
    env: int,
    count: int,
    radius: wp.array2d(dtype=wp.float32),
    shape: wp.array2d(dtype=wp.int32),
    bound: wp.array2d(dtype=wp.vec4),
    # out
    key: wp.array2d(dtype=wp.float32),
):
    """Keys that put neighbours next to each other, and what has no end before all others."""
    low = wp.vec3(INF, INF, INF)
    high = wp.vec3(-INF, -INF, -INF)
    for slot in range(count):
        if radius[env, shape[env, slot]] < INF:
            c = wp.vec3(bound[env, slot][0], bound[env, slot][1], bound[env, slot][2])
            low = wp.min(low, c)
            high = wp.max(high, c)
    extent = high - low
    scale = 1.0 / wp.max(wp.max(extent[0], wp.max(extent[1], extent[2])), NOTHING)
    for slot in range(count):
        key[env, slot] = -1.0
        if radius[env, shape[env, slot]] < INF:
            c = wp.vec3(bound[env, slot][0], bound[env, slot][1], bound[env, slot][2])
            key[env, slot] = _curve_position(scale * (c - low))
    return 0


@wp.kernel(module="unique", enable_backward=False)
def bound_groups(
    env_offset: int,
    radius: wp.array2d(dtype=wp.float32),
    slots: Slots,
    # out
    group_out: wp.array2d(dtype=wp.vec4d),
):
    """Centre and radius of a sphere around every GROUP consecutive slots of one environment."""
    env = wp.tid() + env_offset
    count = slots.count[env]
    for group in range((count + GROUP - 1) // GROUP):
        first = group * GROUP
        last = wp.min(first + GROUP, count)
        low = wp.transform_get_translation(slots.pose[env, first])
        high = low
        for slot in range(first + 1, last):
            low = wp.min(low, wp.transform_get_translation(slots.pose[env, slot]))
            high = wp.max(high, wp.transform_get_translation(slots.pose[env, slot]))
        centre = wp.float64(0.5) * (low + high)
        reach = wp.float64(0.0)
        for slot in range(first, last):
            away = wp.length(wp.transform_get_translation(slots.pose[env, slot]) - centre)
            reach = wp.max(reach, away + wp.float64(radius[env, slots.shape[env, slot]]))
        group_out[env, group] = wp.vec4d(centre[0], centre[1], centre[2], reach)


@wp.func
def _is_between(c: wp.vec3, distance: float, radius: float, sin_low: float, sin_high: float):
    """Tell whether a sphere around c, without the origin in it, reaches between two elevations given by their sines.

    Its lowest and highest elevation are that of c minus and plus the angle that its radius fills; where the sum is
    beyond the zenith or the nadir, its cosine is negative, and the sphere holds the pole.
    """
    tangent = wp.sqrt((distance - radius) * (distance + radius))
    level = wp.sqrt(c[0] * c[0] + c[1] * c[1])
    square = distance * distance
    above = level * tangent < c[2] * radius or c[2] * tangent + level * radius >= sin_low * square
    below = level * tangent < -c[2] * radius or c[2] * tangent - level * radius <= sin_high * square
    return above and below


@wp.func
def _apply_order(env: int, count: int, order: wp.array2d(dtype=wp.int32), slots: Slots):
    """Brings one environment's slots into an order, cycle by cycle; ``order`` ends as 0, 1, 2, ..."""
    for start in range(count):
        if order[env, start] != start:
            bound = slots.bound[env, start]
            shape = slots.shape[env, start]
            axes = slots.axes[env, start]
            pose = slots.pose[env, start]
            slot = int(start)
            while order[env, slot] != start:
                other = order[env, slot]
                slots.bound[env, slot] = slots.bound[env, other]
                slots.shape[env, slot] = slots.shape[env, other]
                slots.axes[env, slot] = slots.axes[env, other]
                slots.pose[env, slot] = slots.pose[env, other]
                order[env, slot] = slot
                slot = other
            slots.bound[env, slot] = bound
            slots.shape[env, slot] = shape
            slots.axes[env, slot] = axes
            slots.pose[env, slot] = pose
            order[env, slot] = slot
    return 0


@wp.kernel(module="unique", enable_backward=False)
def place_shapes(
    env_offset: int,
    # scene
    body_pos: wp.array2d(dtype=Any),
    body_quat: wp.array2d(dtype=Any),
    geometry: Geometry,
    visible: wp.array2d(dtype=wp.bool),
    # viewer
    viewpoint: Viewpoint,
    limits: Limits,
    # scratch
    order: wp.array2d(dtype=wp.int32),
    spare: wp.array2d(dtype=wp.float32),
    # out
    slots: Slots,
):
    """Expresses one environment's shapes in the viewer's frame, nearest first, without those out of reach.

    Poses are composed in float64. Without ``limits.cull``, none is left out, neighbours stand together, and
    ``slots.near`` then holds no distances.
    """
    env = wp.tid() + env_offset
    count = wp.int32(0)
    view = viewpoint.pose
    has_view = bool(True)
    if viewpoint.body >= 0:
        p_carrier = wp.vec3d(body_pos[env, viewpoint.body])
        q_carrier = wp.vec4d(body_quat[env, viewpoint.body])
        has_view = is_pose(p_carrier, q_carrier)
        if has_view:
            view = to_pose(p_carrier, q_carrier) * view
    to_view = wp.transform_inverse(view)
    slots.view[env] = view
    sin_low = wp.sin(wp.max(limits.elevation_min - MARGIN, -HALF_PI)) - ROUNDING
    sin_high = wp.sin(wp.min(limits.elevation_max + MARGIN, HALF_PI)) + ROUNDING
    for i in range(limits.num_viewed):
        # pose in the viewer's frame
        shape = limits.viewed[i]
        body = geometry.body[shape]
        pose = geometry.pose[shape]
        there = bool(has_view)
        if visible:
            there = there and visible[env, shape]
        if body >= 0:
            p_body = wp.vec3d(body_pos[env, body])
            q_body = wp.vec4d(body_quat[env, body])
            there = there and is_pose(p_body, q_body)
            pose = to_pose(p_body, q_body) * pose
        pose = to_view * pose
        if there:
            kind = geometry.kind[shape]
            size = geometry.size[env, shape]
            radius = geometry.radius[env, shape]
            c = flush_denormals(wp.vec3(wp.transform_get_translation(pose)))
            axes = axes_of(pose)
            z_axis = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
            # bounds: nearest distance, and the cone in which rays can hit it
            distance = wp.length(c)
            near = distance_to_shape(kind, c, axes, size, radius)
            near = wp.max(near - ROUNDING * distance, 0.0)
            threshold = -INF
            if distance > radius * (1.0 + SLACK):
                threshold = (distance - radius) * (distance + radius) * (1.0 - SLACK) - radius * radius * SLACK
            bound = wp.vec4(c[0], c[1], c[2], threshold)
            if limits.cull:
                there = near < limits.max_range
                if kind == PLANE:
                    height = -wp.dot(c, z_axis)
                    there = there and height >= -slots.reach
                    if size[0] <= 0.0 and size[1] <= 0.0:
                        bound = wp.vec4(-height * z_axis[0], -height * z_axis[1], -height * z_axis[2], 0.0)
                elif distance > radius * (1.0 + SLACK):
                    there = there and _is_between(c, distance, radius, sin_low, sin_high)
            if there:
                slots.bound[env, count] = bound
                slots.near[env, count] = near
                slots.shape[env, count] = shape
                slots.axes[env, count] = axes
                slots.pose[env, count] = pose
                order[env, count] = count
                count += 1
    slots.count[env] = count
    if not limits.cull:
        _order_along_curve(env, count, geometry.radius, slots.shape, slots.bound, slots.near)
    _sort_by_distance(env, count, slots.near, order, spare)
    _apply_order(env, count, order, slots)
    if slots.words:
        pack_words(slots, env, count)
