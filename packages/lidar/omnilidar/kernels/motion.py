"""Poses within a frame, and bounds of what moves during it. Poses are composed in float64."""

# ruff: noqa: UP018  (in a kernel, int(0) and float(0) declare a variable that may change)

import math
from typing import Any

import warp as wp

from .geometry import INF, PI
from .rotations import is_pose, to_quatd
from .slots import Slots, Viewpoint, pack_words

wp.set_module_options({"enable_backward": False})

HELD = wp.constant(wp.float64(-1.0))
"""Half angle of a segment in which a body jumped: it has the segment's last pose all along."""
BROKEN = wp.constant(wp.float64(-2.0))
"""Half angle of a segment at whose end a body has no pose: it is not there."""

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
ANGLE_SLACK = wp.constant(wp.float32(1.0e-3))
HALF_PI = wp.constant(wp.float32(0.5 * math.pi))


@wp.struct
class Track:
    """Poses of all bodies at K + 1 evenly spaced moments of a frame, the oldest in row ``oldest``."""

    pos: wp.array3d(dtype=wp.vec3d)  # (K + 1, num_envs, B)
    quat: wp.array3d(dtype=wp.quatd)  # (K + 1, num_envs, B) unit length
    turn: wp.array3d(dtype=wp.vec4d)  # (K + 1, num_envs, B) axis and half angle of the turn to the next moment
    oldest: wp.array(dtype=wp.int32)  # (1,)
    segments: int  # K
    shape_body: wp.array(dtype=wp.int32)
    shape_pose: wp.array(dtype=wp.transformd)


@wp.struct
class Moment:
    """A time within a frame, where the sensor is then, and where in its frame the ray starts."""

    segment: wp.int32
    fraction: wp.float32  # of the segment
    view: wp.transformd
    to_view: wp.transformd
    origin: wp.vec3


@wp.kernel(module="unique", enable_backward=False)
def record_poses(
    env_offset: int,
    body_pos: wp.array2d(dtype=Any),
    body_quat: wp.array2d(dtype=Any),
    newest: wp.array(dtype=wp.int32),
    jump: float,
    # in and out
    forget: wp.array(dtype=wp.bool),
    # out
    pos_out: wp.array3d(dtype=wp.vec3d),
    quat_out: wp.array3d(dtype=wp.quatd),
    turn_out: wp.array3d(dtype=wp.vec4d),
):
    """Stores one environment's poses as the newest moment, and how each body turned on the way there.

    Where ``forget`` is set, the bodies have these poses at all moments, and it is cleared.
    """
    env = wp.tid() + env_offset
    rows = pos_out.shape[0]
    new = newest[0]
    last = (new + rows - 1) % rows
    before = (new + rows - 2) % rows
    for body in range(body_pos.shape[1]):
        p = wp.vec3d(body_pos[env, body])
        wxyz = wp.vec4d(body_quat[env, body])
        q = to_quatd(wxyz)
        if forget[env]:
            turn = wp.vec4d(ZERO, ZERO, ONE, wp.where(is_pose(p, wxyz), ZERO, BROKEN))
            for row in range(rows):
                pos_out[row, env, body] = p
                quat_out[row, env, body] = q
                turn_out[row, env, body] = turn
        else:
            turn = wp.vec4d(ZERO, ZERO, ONE, HELD)
            was_there = turn_out[before, env, body][3] > BROKEN
            if not is_pose(p, wxyz):
                turn[3] = BROKEN
            elif was_there and wp.length(p - pos_out[last, env, body]) <= wp.float64(jump):
                step = wp.quat_inverse(quat_out[last, env, body]) * q
                if step[3] < ZERO:
                    step = -step
                axis = wp.vec3d(step[0], step[1], step[2])
                size = wp.length(axis)
                turn[3] = ZERO
                if size > wp.float64(1.0e-12):
                    turn = wp.vec4d(axis[0] / size, axis[1] / size, axis[2] / size, wp.atan2(size, step[3]))
            turn_out[last, env, body] = turn
            pos_out[new, env, body] = p
            quat_out[new, env, body] = q
    forget[env] = False


@wp.func
def body_at(track: Track, env: int, body: int, segment: int, fraction: float):
    """Pose within a segment: the position moves evenly along a line, the orientation evenly about an axis."""
    first = (track.oldest[0] + segment) % (track.segments + 1)
    second = (first + 1) % (track.segments + 1)
    turn = track.turn[first, env, body]
    p = track.pos[second, env, body]
    q = track.quat[second, env, body]
    if turn[3] >= ZERO:
        part = wp.float64(fraction)
        start = track.pos[first, env, body]
        p = start + part * (p - start)
        q = track.quat[first, env, body]
        if turn[3] > ZERO:
            angle = part * turn[3]
            sine = wp.sin(angle)
            q = q * wp.quatd(turn[0] * sine, turn[1] * sine, turn[2] * sine, wp.cos(angle))
    return wp.transformation(p, q)


@wp.func
def shape_at(track: Track, env: int, shape: int, segment: int, fraction: float):
    """Pose of a shape in its environment."""
    pose = track.shape_pose[shape]
    body = track.shape_body[shape]
    if body >= 0:
        pose = body_at(track, env, body, segment, fraction) * pose
    return pose


@wp.func
def view_at(track: Track, env: int, viewpoint: Viewpoint, segment: int, fraction: float):
    """Pose of the sensor."""
    pose = viewpoint.pose
    if viewpoint.body >= 0:
        pose = body_at(track, env, viewpoint.body, segment, fraction) * pose
    return pose


@wp.func
def moment_at(track: Track, env: int, viewpoint: Viewpoint, time: float):
    """The moment at ``time`` from 0, the frame's start, to 1, its end."""
    scaled = wp.clamp(time, 0.0, 1.0) * float(track.segments)
    moment = Moment()
    moment.segment = wp.min(int(scaled), track.segments - 1)
    moment.fraction = scaled - float(moment.segment)
    moment.view = view_at(track, env, viewpoint, moment.segment, moment.fraction)
    moment.to_view = wp.transform_inverse(moment.view)
    return moment


@wp.func
def is_there(track: Track, env: int, body: int):
    """Tell whether a body has a pose all along."""
    there = bool(True)
    if body >= 0:
        for segment in range(track.segments):
            row = (track.oldest[0] + segment) % (track.segments + 1)
            there = there and track.turn[row, env, body][3] > BROKEN
    return there


@wp.func
def chord_error(track: Track, env: int, body: int, pose: wp.transformd):
    """Distance by which a point fixed at ``pose`` on a turning body strays from even motion along a line.

    A function whose second derivative is at most arm * angle^2 differs by an eighth of that from its chord.
    """
    largest = ZERO
    if body >= 0:
        for segment in range(track.segments):
            row = (track.oldest[0] + segment) % (track.segments + 1)
            largest = wp.max(largest, track.turn[row, env, body][3])
    return 0.5 * wp.length(wp.vec3(wp.transform_get_translation(pose))) * float(largest * largest)


@wp.func
def angle_between(a: wp.transformd, b: wp.transformd):
    cosine = wp.abs(wp.dot(wp.transform_get_rotation(a), wp.transform_get_rotation(b)))
    return 2.0 * wp.acos(wp.min(float(cosine), 1.0))


@wp.kernel(module="unique", enable_backward=False)
def bound_swept_shapes(
    env_offset: int,
    track: Track,
    shape_radius: wp.array2d(dtype=wp.float32),
    visible: wp.array2d(dtype=wp.bool),
    viewed: wp.array(dtype=wp.int32),
    num_viewed: int,
    viewpoint: Viewpoint,
    max_range: float,
    # out
    slots: Slots,
):
    """Bounds of one environment's shapes over the whole frame, in the sensor's frame at its middle, nearest first.

    The positions relative to the sensor lie in a ball around their values at the moments, and the sensor's orientation
    within ``turned`` of the middle one (a geodesic between two points of a ball below a right angle stays in it): a ray
    can hit the shape only within the ball's cone widened by that angle.
    """
    env = wp.tid() + env_offset
    middle = moment_at(track, env, viewpoint, 0.5)
    turned = float(0.0)
    for end in range(2 * track.segments):
        turned = wp.max(turned, angle_between(middle.view, view_at(track, env, viewpoint, end // 2, float(end % 2))))
    if turned >= HALF_PI:
        turned = PI
    view_error = chord_error(track, env, viewpoint.body, viewpoint.pose)
    has_view = is_there(track, env, viewpoint.body)
    count = wp.int32(0)
    for i in range(num_viewed):
        shape = viewed[i]
        there = bool(has_view) and is_there(track, env, track.shape_body[shape])
        if visible:
            there = there and visible[env, shape]
        bound = wp.vec4(0.0, 0.0, 0.0, -INF)
        near = float(0.0)
        if there and shape_radius[env, shape] < INF:
            low = wp.vec3(INF, INF, INF)
            high = wp.vec3(-INF, -INF, -INF)
            for end in range(2 * track.segments):
                at = wp.transform_get_translation(shape_at(track, env, shape, end // 2, float(end % 2)))
                seen_from = wp.transform_get_translation(view_at(track, env, viewpoint, end // 2, float(end % 2)))
                offset = wp.vec3(at - seen_from)
                low = wp.min(low, offset)
                high = wp.max(high, offset)
            centre = 0.5 * (low + high)
            chord_errors = view_error + chord_error(track, env, track.shape_body[shape], track.shape_pose[shape])
            radius = (shape_radius[env, shape] + 0.5 * wp.length(high - low) + chord_errors) * (1.0 + ANGLE_SLACK)
            distance = wp.length(centre)
            near = wp.max(distance - radius, 0.0)
            if distance > radius:
                cosine = wp.cos(wp.min(wp.asin(radius / distance) + turned + ANGLE_SLACK, PI))
                c = wp.vec3(wp.quat_rotate_inv(wp.transform_get_rotation(middle.view), wp.vec3d(centre)))
                bound = wp.vec4(c[0], c[1], c[2], cosine * wp.abs(cosine) * distance * distance)
        if there and near < max_range:
            slot = count
            while slot > 0 and slots.near[env, wp.max(slot - 1, 0)] > near:
                slots.bound[env, slot] = slots.bound[env, slot - 1]
                slots.near[env, slot] = slots.near[env, slot - 1]
                slots.shape[env, slot] = slots.shape[env, slot - 1]
                slot -= 1
            slots.bound[env, slot] = bound
            slots.near[env, slot] = near
            slots.shape[env, slot] = shape
            count += 1
    slots.count[env] = count
    if slots.words:
        pack_words(slots, env, count)
