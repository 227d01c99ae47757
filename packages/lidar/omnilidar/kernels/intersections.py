"""Intersections of rays with analytic shapes in closed form, for either floating point type."""

import math
from functools import cache

import warp as wp


@cache
def intersections(real: type) -> tuple[wp.Function, ...]:
    """Functions (plane, sphere, box, cylinder, capsule, ellipsoid) in ``wp.float32`` or ``wp.float64``.

    They intersect a line from the frame's origin along unit ``d`` with a shape centred at ``c``; ``axes`` holds the
    shape's x, y and z axis in its rows, ``size`` is that of ``Shape``. Each returns ``(t, sin_incidence)``: the first
    crossing at t >= 0, infinite for a miss, and the sine of the angle between ray and surface there, by which rounding
    errors are divided. A closed shape is convex, so a line is in it between two crossings; a ray that starts inside
    hits the second one, as in mj_ray. A plane is hit from the side of its normal only, and within its half extents
    where they are not 0.
    """
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    infinite = wp.constant(real(math.inf))
    far = wp.constant(real(1.0e9))
    parallel = wp.constant(real(1.0e-12 if real == wp.float32 else 1.0e-20))
    zero = wp.constant(real(0.0))
    one = wp.constant(real(1.0))

    @wp.func
    def away_from_zero(x: real):
        if wp.abs(x) < parallel:
            return wp.where(x < zero, -parallel, parallel)
        return x

    @wp.func
    def first_crossing(t_in: real, t_out: real, sin_in: real, sin_out: real):
        if t_in > t_out or t_out < zero:
            return vec2(infinite, one)
        return wp.where(t_in >= zero, vec2(t_in, sin_in), vec2(t_out, sin_out))

    @wp.func
    def plane(d: vec3, c: vec3, axes: mat33, size: vec3):
        sine = axes[2, 0] * d[0] + axes[2, 1] * d[1] + axes[2, 2] * d[2]
        height = axes[2, 0] * c[0] + axes[2, 1] * c[1] + axes[2, 2] * c[2]
        if sine > -parallel or height > zero:
            return vec2(infinite, one)
        t = height / sine
        if size[0] > zero or size[1] > zero:
            p = t * d - c
            x = wp.abs(axes[0, 0] * p[0] + axes[0, 1] * p[1] + axes[0, 2] * p[2])
            y = wp.abs(axes[1, 0] * p[0] + axes[1, 1] * p[1] + axes[1, 2] * p[2])
            if (size[0] > zero and x > size[0]) or (size[1] > zero and y > size[1]):
                return vec2(infinite, one)
        return vec2(t, -sine)

    @wp.func
    def sphere(d: vec3, c: vec3, size: vec3):
        t_mid = wp.dot(d, c)
        across = c - t_mid * d
        disc = size[0] * size[0] - wp.dot(across, across)
        if disc < zero:
            return vec2(infinite, one)
        half = wp.sqrt(disc)
        sine = half / size[0]
        return first_crossing(t_mid - half, t_mid + half, sine, sine)

    @wp.func
    def box(d: vec3, c: vec3, axes: mat33, size: vec3):
        direction = axes * d
        centre = axes * c
        sine = wp.abs(direction)
        inv = vec3(
            one / away_from_zero(direction[0]), one / away_from_zero(direction[1]), one / away_from_zero(direction[2])
        )
        mid = wp.cw_mul(centre, inv)
        half = wp.cw_mul(size, wp.abs(inv))
        low = mid - half
        high = mid + half
        t_in = wp.max(wp.max(low[0], low[1]), low[2])
        t_out = wp.min(wp.min(high[0], high[1]), high[2])
        sin_in = wp.where(low[0] == t_in, sine[0], wp.where(low[1] == t_in, sine[1], sine[2]))
        sin_out = wp.where(high[0] == t_out, sine[0], wp.where(high[1] == t_out, sine[1], sine[2]))
        return first_crossing(t_in, t_out, sin_in, sin_out)

    @wp.func
    def ellipsoid(d: vec3, c: vec3, axes: mat33, size: vec3):
        direction = wp.cw_div(axes * d, size)
        centre = wp.cw_div(axes * c, size)
        dd = wp.dot(direction, direction)
        t_mid = wp.dot(centre, direction) / dd
        across = centre - t_mid * direction
        disc = one - wp.dot(across, across)
        if disc < zero:
            return vec2(infinite, one)
        half = wp.sqrt(disc / dd)
        sine = half * dd * wp.min(size[0], wp.min(size[1], size[2]))  # a lower bound
        return first_crossing(t_mid - half, t_mid + half, sine, sine)

    @wp.func
    def tube(d: vec3, c: vec3, axis: vec3, radius: real):
        """(t_in, t_out, sin_incidence) of the infinite cylinder around ``axis``; t_in > t_out if the line misses it."""
        across = wp.cross(d, axis)
        moment = wp.cross(axis, c)
        a = wp.dot(across, across)
        offset = wp.dot(d, moment)
        disc = radius * radius * a - offset * offset
        if a < parallel:
            inside = wp.dot(moment, moment) <= radius * radius
            return wp.where(inside, vec3(-far, far, zero), vec3(far, -far, zero))
        if disc < zero:
            return vec3(far, -far, zero)
        t_mid = -wp.dot(across, moment) / a
        root = wp.sqrt(disc)
        half = root / a
        return vec3(t_mid - half, t_mid + half, root / radius)

    @wp.func
    def cylinder(d: vec3, c: vec3, axes: mat33, size: vec3):
        axis = vec3(axes[2, 0], axes[2, 1], axes[2, 2])
        side = tube(d, c, axis, size[0])
        if side[0] > side[1]:
            return vec2(infinite, one)
        sine = wp.dot(d, axis)
        inv = one / away_from_zero(sine)
        mid = wp.dot(c, axis) * inv
        half = size[1] * wp.abs(inv)
        sin_in = wp.where(mid - half > side[0], wp.abs(sine), side[2])
        sin_out = wp.where(mid + half < side[1], wp.abs(sine), side[2])
        return first_crossing(wp.max(side[0], mid - half), wp.min(side[1], mid + half), sin_in, sin_out)

    @wp.func
    def half_chord(d: vec3, c: vec3, radius: real):
        """Half the chord that the line cuts from a sphere; negative if it misses."""
        across = c - wp.dot(d, c) * d
        disc = radius * radius - wp.dot(across, across)
        if disc < zero:
            return -one
        return wp.sqrt(disc)

    @wp.func
    def capsule(d: vec3, c: vec3, axes: mat33, size: vec3):
        axis = vec3(axes[2, 0], axes[2, 1], axes[2, 2])
        side = tube(d, c, axis, size[0])
        if side[0] > side[1]:
            return vec2(infinite, one)
        sine = wp.dot(d, axis)
        height = wp.dot(c, axis)
        t_in = side[0]
        t_out = side[1]
        sin_in = side[2]
        sin_out = side[2]
        z_in = t_in * sine - height
        z_out = t_out * sine - height
        if wp.abs(z_in) > size[1]:
            cap = c + wp.clamp(z_in, -size[1], size[1]) * axis
            half = half_chord(d, cap, size[0])
            if half < zero:
                return vec2(infinite, one)
            t_in = wp.dot(d, cap) - half
            sin_in = half / size[0]
        if wp.abs(z_out) > size[1]:
            cap_out = c + wp.clamp(z_out, -size[1], size[1]) * axis
            half_out = half_chord(d, cap_out, size[0])
            if half_out < zero:
                return vec2(infinite, one)
            t_out = wp.dot(d, cap_out) + half_out
            sin_out = half_out / size[0]
        return first_crossing(t_in, t_out, sin_in, sin_out)

    return plane, sphere, box, cylinder, capsule, ellipsoid
