"""Warp kernel of robots without legs: outlines that follow an asked velocity and touch what stands in the way."""

import warp as wp

from omniperception.avoidance.kernels import nearest_point

SAMPLES = 5
"""Points of the capsule's line at which its distance from a rectangle is looked up, besides the rectangle's corners."""


@wp.func
def turned(v: wp.vec2, angle: float) -> wp.vec2:
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec2(c * v[0] - s * v[1], s * v[0] + c * v[1])


@wp.func
def moved(now: wp.vec2, there: wp.vec2, most: float) -> wp.vec2:
    change = there - now
    return now + change * (most / wp.max(wp.length(change), most))


@wp.func
def nearer(gap: wp.vec2, other: wp.vec2) -> wp.vec2:
    if wp.dot(other, other) < wp.dot(gap, gap):
        return other
    return gap


@wp.func
def gap_to(place: wp.vec2, axis: wp.vec2, outline: wp.vec2, half_length: float) -> wp.vec2:
    """The shortest vector from the line (-half_length, 0) to (half_length, 0) to an outline around `place`; 0 where
    they meet."""
    if outline[1] < 0.0:
        away = place - wp.vec2(wp.clamp(place[0], -half_length, half_length), 0.0)
        length = wp.length(away)
        return away * (wp.max(length - outline[0], 0.0) / wp.max(length, 1.0e-6))
    across = wp.vec2(-axis[1], axis[0])
    gap = wp.vec2(1.0e3, 0.0)
    for k in range(SAMPLES):
        on_line = wp.vec2(half_length * (2.0 * float(k) / float(SAMPLES - 1) - 1.0), 0.0)
        gap = nearer(gap, nearest_point(place - on_line, axis, outline))
    for k in range(4):
        x = wp.where(k < 2, outline[0], -outline[0])
        y = wp.where(k % 2 == 0, outline[1], -outline[1])
        corner = place + x * axis + y * across
        gap = nearer(gap, corner - wp.vec2(wp.clamp(corner[0], -half_length, half_length), 0.0))
    return gap


@wp.kernel(module="unique", enable_backward=False)
def walk(
    env_offset: int,
    dt: float,
    num_steps: int,
    most_linear: float,
    most_angular: float,
    half_length: float,
    mass: float,
    headroom: float,
    target: wp.array(dtype=wp.vec3),
    before: wp.array(dtype=wp.vec3),
    gain: wp.array(dtype=wp.vec3),
    lag: wp.array(dtype=wp.vec3),
    delay: wp.array(dtype=wp.vec3),
    error: wp.array(dtype=wp.vec3),
    radius: wp.array(dtype=wp.float32),
    part_path: wp.array3d(dtype=wp.vec3),
    quat_path: wp.array3d(dtype=wp.vec4),
    turns: int,
    part_velocity: wp.array2d(dtype=wp.vec2),
    active: wp.array2d(dtype=wp.bool),
    half_height: wp.array2d(dtype=wp.float32),
    part_radius: wp.array2d(dtype=wp.float32),
    outline: wp.array2d(dtype=wp.vec2),
    # in and out
    place: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    asked: wp.array(dtype=wp.vec3),
    # out
    touched_out: wp.array(dtype=wp.bool),
    impulse_out: wp.array(dtype=wp.float32),
    places_out: wp.array2d(dtype=wp.vec3),
    velocities_out: wp.array2d(dtype=wp.vec3),
):
    """One environment's robot through the steps of a control step; see `PlanarSimulator`."""
    env = wp.tid() + env_offset
    p = place[env]
    v = velocity[env]
    u = asked[env]
    old = before[env]
    new = target[env]
    late = delay[env]
    slow = lag[env]
    g = gain[env]
    wrong = error[env]
    r = radius[env]
    hits = wp.int32(0)
    impulse = wp.float32(0.0)
    for step in range(num_steps):
        begin = float(step) * dt
        goal = wp.vec3()
        keep = wp.vec3()
        for k in range(3):
            share = wp.clamp((late[k] - begin) / dt, 0.0, 1.0)
            goal[k] = share * old[k] + (1.0 - share) * new[k]
            keep[k] = wp.exp(-dt / wp.max(slow[k], 1.0e-4))
        linear = moved(wp.vec2(u[0], u[1]), wp.vec2(goal[0], goal[1]), most_linear * dt)
        u = wp.vec3(linear[0], linear[1], u[2] + wp.clamp(goal[2] - u[2], -most_angular * dt, most_angular * dt))
        for k in range(3):
            v[k] = g[k] * u[k] + wrong[k] + keep[k] * (v[k] - g[k] * u[k] - wrong[k])
        heading = p[2] + 0.5 * dt * v[2]
        way = turned(wp.vec2(v[0], v[1]), heading) * dt
        p = wp.vec3(p[0] + way[0], p[1] + way[1], p[2] + dt * v[2])
        for o in range(part_path.shape[2]):
            at = part_path[env, step, o]
            if active[env, o] and at[2] - half_height[env, o] < headroom:
                away = wp.vec2(at[0] - p[0], at[1] - p[1])
                if wp.length(away) < part_radius[env, o] + r + half_length:
                    quat = quat_path[env, step * turns, o]
                    yaw = 2.0 * wp.atan2(quat[3], quat[0]) - p[2]
                    axis = wp.vec2(wp.cos(yaw), wp.sin(yaw))
                    here = turned(away, -p[2])
                    gap = gap_to(here, axis, outline[env, o], half_length)
                    length = wp.length(gap)
                    if length < r:
                        hits += 1
                        if length < 1.0e-5:
                            gap = here
                        normal = gap / wp.max(wp.length(gap), 1.0e-6)
                        theirs = turned(part_velocity[env, o], -p[2])
                        closing = wp.dot(wp.vec2(v[0], v[1]) - theirs, normal)
                        if closing > 0.0:
                            impulse += mass * closing
                            v = wp.vec3(v[0] - closing * normal[0], v[1] - closing * normal[1], v[2])
                        back = turned(normal, p[2]) * (r - length)
                        p = wp.vec3(p[0] - back[0], p[1] - back[1], p[2])
        places_out[env, step] = p
        velocities_out[env, step] = v
    place[env] = p
    velocity[env] = v
    asked[env] = u
    touched_out[env] = hits > 0
    impulse_out[env] = impulse
