"""Warp kernels of the true sectors and of the velocity risk, one thread for each environment."""

import math

import warp as wp

from omnilidar.kernels.sectors import sector_of


@wp.func
def slab(start: float, direction: float, half: float):
    """Points at which a line enters and leaves |x| <= half."""
    step = direction
    if wp.abs(step) < 1.0e-9:
        step = wp.float32(1.0e-9)
    a = (-half - start) / step
    b = (half - start) / step
    return wp.vec2(wp.min(a, b), wp.max(a, b))


@wp.func
def entry(place: wp.vec2, axis: wp.vec2, outline: wp.vec2, direction: wp.vec2) -> float:
    """Distance at which a ray from the origin enters an outline, 0 inside, infinite if it misses."""
    if outline[1] < 0.0:
        along = wp.dot(place, direction)
        chord = outline[0] * outline[0] - wp.dot(place, place) + along * along
        if chord <= 0.0 or along + wp.sqrt(chord) <= 0.0:
            return wp.inf
        return wp.max(along - wp.sqrt(chord), 0.0)
    across = wp.vec2(-axis[1], axis[0])
    x = slab(-wp.dot(place, axis), wp.dot(direction, axis), outline[0])
    y = slab(-wp.dot(place, across), wp.dot(direction, across), outline[1])
    enter = wp.max(x[0], y[0])
    leave = wp.min(x[1], y[1])
    if enter > leave or leave <= 0.0:
        return wp.inf
    return wp.max(enter, 0.0)


@wp.func
def nearest_point(place: wp.vec2, axis: wp.vec2, outline: wp.vec2) -> wp.vec2:
    """The point of an outline that is nearest to the origin."""
    if outline[1] < 0.0:
        return place * wp.max(1.0 - outline[0] / wp.max(wp.length(place), 1.0e-9), 0.0)
    across = wp.vec2(-axis[1], axis[0])
    x = wp.clamp(-wp.dot(place, axis), -outline[0], outline[0])
    y = wp.clamp(-wp.dot(place, across), -outline[1], outline[1])
    return place + x * axis + y * across


@wp.func
def around(outline: wp.vec2) -> float:
    """Radius of the circle around an outline."""
    if outline[1] < 0.0:
        return outline[0]
    return wp.length(outline)


@wp.func
def keep_nearer(distance: float, velocity: wp.vec2, sector: wp.vec3) -> wp.vec3:
    if distance < sector[0]:
        return wp.vec3(distance, velocity[0], velocity[1])
    return sector


@wp.kernel(module="unique", enable_backward=False)
def nearest_by_sector(
    env_offset: int,
    place: wp.array2d(dtype=wp.vec2),
    axis: wp.array2d(dtype=wp.vec2),
    velocity: wp.array2d(dtype=wp.vec2),
    counts: wp.array2d(dtype=wp.bool),
    outline: wp.array2d(dtype=wp.vec2),
    # out
    sectors_out: wp.array2d(dtype=wp.vec3),
):
    """Every obstacle of one environment in turn; see `TrueSectors`."""
    env = wp.tid() + env_offset
    num_sectors = sectors_out.shape[1]
    width = 2.0 * wp.static(math.pi) / float(num_sectors)
    for o in range(place.shape[1]):
        if counts[env, o]:
            p = place[env, o]
            a = axis[env, o]
            w = velocity[env, o]
            near = nearest_point(p, a, outline[env, o])
            own = sector_of(near[0], near[1], num_sectors)
            sectors_out[env, own] = keep_nearer(wp.length(near), w, sectors_out[env, own])
            first = wp.int32(0)
            count = wp.int32(num_sectors)
            away = wp.length(p)
            reach = around(outline[env, o])
            if away > reach:  # middles of other sectors pass by
                half = wp.asin(reach / away) / width + 1.0e-3
                middle = (wp.atan2(p[1], p[0]) + wp.static(math.pi)) / width - 0.5
                first = wp.int32(wp.ceil(middle - half))
                count = wp.min(wp.int32(wp.floor(middle + half)) - first + 1, num_sectors)
            for k in range(count):
                s = (first + k + 2 * num_sectors) % num_sectors
                angle = (float(s) + 0.5) * width - wp.static(math.pi)
                distance = entry(p, a, outline[env, o], wp.vec2(wp.cos(angle), wp.sin(angle)))
                if distance < sectors_out[env, s][0]:
                    sectors_out[env, s] = keep_nearer(distance, w, sectors_out[env, s])


@wp.func
def squared_from_line(apart: wp.vec2, half_length: float) -> float:
    """Squared distance from the line from (-half_length, 0) to (half_length, 0)."""
    along = wp.max(wp.abs(apart[0]) - half_length, 0.0)
    return along * along + apart[1] * apart[1]


@wp.func
def exponent_of(squared: float, time: float, radius: float, decay: float, time_constant: float) -> float:
    """Minus the logarithm of the risk of passing at a squared distance after a time."""
    return wp.max(wp.sqrt(squared) - radius, 0.0) / decay + time / time_constant


@wp.kernel(module="unique", enable_backward=False)
def worst_sectors(
    env_offset: int,
    place: wp.array2d(dtype=wp.vec2),
    velocity: wp.array2d(dtype=wp.vec2),
    candidates: wp.array(dtype=wp.vec2),
    times: wp.array(dtype=wp.float32),
    robot_radius: float,
    robot_half_length: float,
    decay: float,
    time_constant: float,
    out_of_reach: float,
    # work memory
    points: wp.array2d(dtype=wp.vec2),
    sectors: wp.array2d(dtype=wp.int32),
    least: wp.array2d(dtype=wp.float32),
    # out
    sector_out: wp.array2d(dtype=wp.int64),
    time_out: wp.array2d(dtype=wp.float32),
):
    """Sector and time that determine each candidate's risk, of one environment; see `VelocityRisk`."""
    env = wp.tid() + env_offset
    for k in range(candidates.shape[0]):
        least[env, k] = wp.inf
    for t in range(times.shape[0]):
        time = times[t]
        present = wp.int32(0)
        for s in range(place.shape[1]):
            p = place[env, s]
            if wp.abs(p[0]) + wp.abs(p[1]) < out_of_reach:
                points[env, present] = p + time * velocity[env, s]
                sectors[env, present] = s
                present += 1
        for k in range(candidates.shape[0]):
            goal = time * candidates[k]
            nearest = float(wp.inf)
            at = wp.int32(0)
            for j in range(present):
                squared = squared_from_line(points[env, j] - goal, robot_half_length)
                if squared < nearest:
                    nearest = squared
                    at = j
            if present > 0:
                exponent = exponent_of(nearest, time, robot_radius, decay, time_constant)
                if exponent < least[env, k]:
                    least[env, k] = exponent
                    sector_out[env, k] = wp.int64(sectors[env, at])
                    time_out[env, k] = time


@wp.kernel(module="unique", enable_backward=False)
def largest_risks(
    env_offset: int,
    sectors: wp.array2d(dtype=wp.vec3),
    bearings: wp.array(dtype=wp.vec2),
    candidates: wp.array(dtype=wp.vec2),
    times: wp.array(dtype=wp.float32),
    robot_radius: float,
    robot_half_length: float,
    decay: float,
    time_constant: float,
    max_speed: float,
    none_from: float,
    # work memory
    points: wp.array2d(dtype=wp.vec2),
    # out
    risk_out: wp.array2d(dtype=wp.float32),
):
    """The candidates' risks in one environment; see `VelocityRisk`. Those below exp(-`none_from`) are 0."""
    env = wp.tid() + env_offset
    for k in range(candidates.shape[0]):
        risk_out[env, k] = none_from
    for t in range(times.shape[0]):
        time = times[t]
        left = (none_from - time / time_constant) * decay + robot_radius
        present = wp.int32(0)
        for s in range(sectors.shape[1]):
            sector = sectors[env, s]
            if sector[0] < 1.0e3:
                at = sector[0] * bearings[s] + time * wp.vec2(sector[1], sector[2])
                if wp.length(at) < left + robot_half_length + time * max_speed:
                    points[env, present] = at
                    present += 1
        if present > 0:
            for k in range(candidates.shape[0]):
                goal = time * candidates[k]
                nearest = wp.float32(1.0e6)
                for j in range(present):
                    nearest = wp.min(nearest, squared_from_line(points[env, j] - goal, robot_half_length))
                exponent = exponent_of(nearest, time, robot_radius, decay, time_constant)
                risk_out[env, k] = wp.min(risk_out[env, k], exponent)
    for k in range(candidates.shape[0]):
        exponent = risk_out[env, k]
        risk_out[env, k] = wp.where(exponent < none_from, wp.exp(-exponent), 0.0)
