"""Warp kernels: shape poses, exact ray intersections, the LiDAR scan, range noise and sector distances.

Every kernel is compiled on its own, the first time something needs it. ``env_offset`` is a launch's first
environment, so that the environments can be split over CPU threads. Quaternions arrive as (w, x, y, z).
"""

# ruff: noqa: UP018  (in a kernel, int(0) and float(0) declare a variable that may change)

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
BOX = wp.constant(1)
SPHERE = wp.constant(2)
CYLINDER = wp.constant(3)
CAPSULE = wp.constant(4)
ELLIPSOID = wp.constant(5)

INF = wp.constant(wp.float32(math.inf))
PI = wp.constant(wp.float32(math.pi))
FAR = wp.constant(wp.float32(1.0e9))
PARALLEL = wp.constant(wp.float32(1.0e-12))
SLACK = wp.constant(wp.float32(1.0e-5))

ScanRow = wp.types.vector(length=5, dtype=wp.float32)


# --- frames -------------------------------------------------------------------------------------------------


@wp.func
def to_quat(wxyz: wp.vec4):
    return wp.normalize(wp.quat(wxyz[1], wxyz[2], wxyz[3], wxyz[0]))


@wp.func
def away_from_zero(x: float):
    if wp.abs(x) < PARALLEL:
        return wp.where(x < 0.0, -PARALLEL, PARALLEL)
    return x


# --- intersections: a ray from the frame's origin along unit d with a shape centred at c --------------------
# ``axes`` holds the shape's x, y and z axis in its rows. A closed shape is convex, so a line meets it between
# t_in and t_out; a ray that starts inside hits the exit surface, as in mj_ray.


@wp.func
def first_crossing(t_in: float, t_out: float):
    if t_in > t_out or t_out < 0.0:
        return INF
    return wp.where(t_in >= 0.0, t_in, t_out)


@wp.func
def meet_plane(d: wp.vec3, c: wp.vec3, axes: wp.mat33):
    """Hit from the side of the normal only."""
    slope = axes[2, 0] * d[0] + axes[2, 1] * d[1] + axes[2, 2] * d[2]
    height = axes[2, 0] * c[0] + axes[2, 1] * c[1] + axes[2, 2] * c[2]
    if slope > -PARALLEL or height > 0.0:
        return INF
    return height / slope


@wp.func
def meet_sphere(d: wp.vec3, c: wp.vec3, radius: float):
    t_mid = wp.dot(d, c)
    across = c - t_mid * d
    disc = radius * radius - wp.dot(across, across)
    if disc < 0.0:
        return INF
    half = wp.sqrt(disc)
    return first_crossing(t_mid - half, t_mid + half)


@wp.func
def meet_box(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    direction = axes * d
    centre = axes * c
    t_in = -FAR
    t_out = FAR
    for i in range(3):
        inv = 1.0 / away_from_zero(direction[i])
        mid = centre[i] * inv
        half = size[i] * wp.abs(inv)
        t_in = wp.max(t_in, mid - half)
        t_out = wp.min(t_out, mid + half)
    return first_crossing(t_in, t_out)


@wp.func
def meet_ellipsoid(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    direction = wp.cw_div(axes * d, size)
    centre = wp.cw_div(axes * c, size)
    dd = wp.dot(direction, direction)
    t_mid = wp.dot(centre, direction) / dd
    across = centre - t_mid * direction
    disc = 1.0 - wp.dot(across, across)
    if disc < 0.0:
        return INF
    half = wp.sqrt(disc / dd)
    return first_crossing(t_mid - half, t_mid + half)


@wp.func
def meet_tube(d: wp.vec3, c: wp.vec3, axis: wp.vec3, radius: float):
    """t_in and t_out of the infinite cylinder around ``axis``; t_in > t_out if the line misses it."""
    across = wp.cross(d, axis)
    moment = wp.cross(axis, c)
    a = wp.dot(across, across)
    offset = wp.dot(d, moment)
    disc = radius * radius * a - offset * offset
    if a < PARALLEL:
        inside = wp.dot(moment, moment) <= radius * radius
        return wp.where(inside, wp.vec2(-FAR, FAR), wp.vec2(FAR, -FAR))
    if disc < 0.0:
        return wp.vec2(FAR, -FAR)
    t_mid = -wp.dot(across, moment) / a
    half = wp.sqrt(disc) / a
    return wp.vec2(t_mid - half, t_mid + half)


@wp.func
def meet_cylinder(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    axis = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    tube = meet_tube(d, c, axis, size[0])
    if tube[0] > tube[1]:
        return INF
    inv = 1.0 / away_from_zero(wp.dot(d, axis))
    mid = wp.dot(c, axis) * inv
    half = size[1] * wp.abs(inv)
    return first_crossing(wp.max(tube[0], mid - half), wp.min(tube[1], mid + half))


@wp.func
def cap_half_chord(d: wp.vec3, c: wp.vec3, radius: float):
    """Half the chord that the line cuts from a sphere; negative if it misses."""
    across = c - wp.dot(d, c) * d
    disc = radius * radius - wp.dot(across, across)
    if disc < 0.0:
        return float(-1.0)
    return wp.sqrt(disc)


@wp.func
def meet_capsule(d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    axis = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    tube = meet_tube(d, c, axis, size[0])
    if tube[0] > tube[1]:
        return INF
    slope = wp.dot(d, axis)
    height = wp.dot(c, axis)
    t_in = tube[0]
    t_out = tube[1]
    z_in = t_in * slope - height
    z_out = t_out * slope - height
    if wp.abs(z_in) > size[1]:
        cap = c + wp.clamp(z_in, -size[1], size[1]) * axis
        half = cap_half_chord(d, cap, size[0])
        if half < 0.0:
            return INF
        t_in = wp.dot(d, cap) - half
    if wp.abs(z_out) > size[1]:
        cap_out = c + wp.clamp(z_out, -size[1], size[1]) * axis
        half_out = cap_half_chord(d, cap_out, size[0])
        if half_out < 0.0:
            return INF
        t_out = wp.dot(d, cap_out) + half_out
    return first_crossing(t_in, t_out)


@wp.func
def meet(kind: int, d: wp.vec3, c: wp.vec3, axes: wp.mat33, size: wp.vec3):
    """Distance to the shape's surface along unit d; infinite for a miss."""
    if kind == PLANE:
        return meet_plane(d, c, axes)
    if kind == CAPSULE:
        return meet_capsule(d, c, axes, size)
    if kind == SPHERE:
        return meet_sphere(d, c, size[0])
    if kind == BOX:
        return meet_box(d, c, axes, size)
    if kind == CYLINDER:
        return meet_cylinder(d, c, axes, size)
    return meet_ellipsoid(d, c, axes, size)


@wp.func
def outward_normal(kind: int, point: wp.vec3, size: wp.vec3):
    """Unit normal of the surface next to ``point``, both in the shape's own frame."""
    if kind == PLANE:
        return wp.vec3(0.0, 0.0, 1.0)
    if kind == SPHERE:
        return wp.normalize(point)
    if kind == ELLIPSOID:
        return wp.normalize(wp.cw_div(point, wp.cw_mul(size, size)))
    if kind == CAPSULE:
        return wp.normalize(point - wp.vec3(0.0, 0.0, wp.clamp(point[2], -size[1], size[1])))
    if kind == CYLINDER:
        rho = wp.sqrt(point[0] * point[0] + point[1] * point[1])
        if wp.abs(wp.abs(point[2]) - size[1]) < wp.abs(rho - size[0]):
            return wp.vec3(0.0, 0.0, wp.sign(point[2]))
        return wp.normalize(wp.vec3(point[0], point[1], 0.0))
    gap = wp.vec3(
        wp.abs(wp.abs(point[0]) - size[0]),
        wp.abs(wp.abs(point[1]) - size[1]),
        wp.abs(wp.abs(point[2]) - size[2]),
    )
    if gap[0] <= gap[1] and gap[0] <= gap[2]:
        return wp.vec3(wp.sign(point[0]), 0.0, 0.0)
    if gap[1] <= gap[2]:
        return wp.vec3(0.0, wp.sign(point[1]), 0.0)
    return wp.vec3(0.0, 0.0, wp.sign(point[2]))


@wp.func
def distance_to_shape(kind: int, c: wp.vec3, axes: wp.mat33, size: wp.vec3, radius: float):
    """A lower bound (exact except for ellipsoids) of the origin's distance to the shape; 0 inside."""
    p = axes * c
    if kind == PLANE:
        return wp.max(-p[2], 0.0)
    if kind == BOX:
        away = wp.vec3(
            wp.max(wp.abs(p[0]) - size[0], 0.0),
            wp.max(wp.abs(p[1]) - size[1], 0.0),
            wp.max(wp.abs(p[2]) - size[2], 0.0),
        )
        return wp.length(away)
    if kind == CAPSULE:
        beyond = wp.max(wp.abs(p[2]) - size[1], 0.0)
        return wp.max(wp.length(wp.vec3(p[0], p[1], beyond)) - size[0], 0.0)
    if kind == CYLINDER:
        out = wp.max(wp.sqrt(p[0] * p[0] + p[1] * p[1]) - size[0], 0.0)
        over = wp.max(wp.abs(p[2]) - size[1], 0.0)
        return wp.sqrt(out * out + over * over)
    return wp.max(wp.length(c) - radius, 0.0)


# --- poses --------------------------------------------------------------------------------------------------


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


# --- rays ---------------------------------------------------------------------------------------------------


@wp.kernel(module="unique", enable_backward=False)
def cast_scan(
    env_offset: int,
    # scan
    scan: wp.array(dtype=ScanRow),
    first_row: wp.array(dtype=wp.int64),
    stride: int,
    min_range: float,
    max_range: float,
    # scene
    shape_kind: wp.array(dtype=wp.int32),
    shape_size: wp.array(dtype=wp.vec3),
    shape_class: wp.array(dtype=wp.int32),
    slot_bound: wp.array2d(dtype=wp.vec4),
    slot_near: wp.array2d(dtype=wp.float32),
    slot_shape: wp.array2d(dtype=wp.int32),
    slot_axes: wp.array2d(dtype=wp.mat33),
    num_slots: wp.array(dtype=wp.int32),
    # out
    ranges_out: wp.array2d(dtype=wp.float32),
    shape_id_out: wp.array2d(dtype=wp.int32),
    class_id_out: wp.array2d(dtype=wp.int32),
    directions_out: wp.array2d(dtype=wp.vec3),
    elevation_out: wp.array2d(dtype=wp.float32),
    azimuth_out: wp.array2d(dtype=wp.float32),
    row_out: wp.array2d(dtype=wp.int32),
):
    """Casts one ray of the scan from the sensor's origin, in the sensor's frame."""
    i, ray = wp.tid()
    env = i + env_offset
    row = int(first_row[env]) + ray * stride
    if row >= scan.shape[0]:
        row = row % scan.shape[0]
    entry = scan[row]
    d = wp.vec3(entry[0], entry[1], entry[2])
    best = max_range
    hit = wp.int32(-1)
    for s in range(num_slots[env]):
        if slot_near[env, s] >= best:
            break
        bound = slot_bound[env, s]
        ahead = d[0] * bound[0] + d[1] * bound[1] + d[2] * bound[2]
        if ahead * wp.abs(ahead) >= bound[3]:
            shape = slot_shape[env, s]
            c = wp.vec3(bound[0], bound[1], bound[2])
            t = meet(shape_kind[shape], d, c, slot_axes[env, s], shape_size[shape])
            if t < best:
                best = t
                hit = shape
    if hit < 0 or best < min_range:
        best = INF
        hit = wp.int32(-1)
    label = wp.int32(-1)
    if hit >= 0:
        label = shape_class[hit]
    ranges_out[env, ray] = best
    shape_id_out[env, ray] = hit
    class_id_out[env, ray] = label
    directions_out[env, ray] = d
    elevation_out[env, ray] = entry[3]
    azimuth_out[env, ray] = entry[4]
    row_out[env, ray] = row


@wp.kernel(module="unique", enable_backward=False)
def cast_rays(
    env_offset: int,
    # rays
    origins: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=wp.vec3),
    max_range: float,
    with_normals: int,
    # scene
    shape_kind: wp.array(dtype=wp.int32),
    shape_size: wp.array(dtype=wp.vec3),
    shape_radius: wp.array(dtype=wp.float32),
    slot_bound: wp.array2d(dtype=wp.vec4),
    slot_shape: wp.array2d(dtype=wp.int32),
    slot_axes: wp.array2d(dtype=wp.mat33),
    num_slots: wp.array(dtype=wp.int32),
    # out
    ranges_out: wp.array2d(dtype=wp.float32),
    shape_id_out: wp.array2d(dtype=wp.int32),
    normals_out: wp.array2d(dtype=wp.vec3),
):
    """Casts one ray with an origin of its own, in the environment's frame."""
    i, ray = wp.tid()
    env = i + env_offset
    origin = origins[env, ray]
    d = wp.normalize(directions[env, ray])
    best = max_range
    hit = wp.int32(-1)
    hit_slot = wp.int32(0)
    for s in range(num_slots[env]):
        shape = slot_shape[env, s]
        bound = slot_bound[env, s]
        c = wp.vec3(bound[0], bound[1], bound[2]) - origin
        radius = shape_radius[shape]
        ahead = wp.dot(d, c)
        away = wp.dot(c, c) - radius * radius * (1.0 + SLACK)
        if away <= SLACK * wp.dot(c, c) or ahead * wp.abs(ahead) >= away - SLACK * wp.dot(c, c):
            t = meet(shape_kind[shape], d, c, slot_axes[env, s], shape_size[shape])
            if t < best:
                best = t
                hit = shape
                hit_slot = s
    if with_normals != 0:
        normal = wp.vec3(0.0, 0.0, 0.0)
        if hit >= 0:
            bound = slot_bound[env, hit_slot]
            axes = slot_axes[env, hit_slot]
            point = axes * (origin + best * d - wp.vec3(bound[0], bound[1], bound[2]))
            normal = wp.transpose(axes) * outward_normal(shape_kind[hit], point, shape_size[hit])
        normals_out[env, ray] = normal
    if hit < 0:
        best = INF
    ranges_out[env, ray] = best
    shape_id_out[env, ray] = hit


# --- noise --------------------------------------------------------------------------------------------------


@wp.kernel(module="unique", enable_backward=False)
def add_noise(
    env_offset: int,
    seed: int,
    frame: wp.array(dtype=wp.int32),
    distance_ratio: float,
    mask_ratio: float,
    mask_low: float,
    mask_high: float,
    min_range: float,
    max_range: float,
    true_ranges: wp.array2d(dtype=wp.float32),
    # out
    ranges_out: wp.array2d(dtype=wp.float32),
):
    """Disturbs the hits of one ray; the random numbers are a function of seed, environment, frame and ray."""
    i, ray = wp.tid()
    env = i + env_offset
    measured = true_ranges[env, ray]
    if measured < INF:
        env_state = wp.rand_init(seed, env)
        frame_state = wp.rand_init(int(env_state), frame[0])
        state = wp.rand_init(int(frame_state), ray)
        factor = 1.0 + distance_ratio * (2.0 * wp.randf(state) - 1.0)
        measured = wp.min(measured * factor, max_range)
        if measured < min_range:
            measured = INF
        if wp.randf(state) < mask_ratio:
            measured = mask_low + (mask_high - mask_low) * wp.randf(state)
    ranges_out[env, ray] = measured


# --- sectors ------------------------------------------------------------------------------------------------


@wp.kernel(module="unique", enable_backward=False)
def sector_minima(
    env_offset: int,
    true_ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    class_id: wp.array2d(dtype=wp.int32),
    base_quat: wp.array(dtype=wp.vec4),
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
    q_base = to_quat(base_quat[env])
    forward = wp.quat_rotate(q_base, wp.vec3(1.0, 0.0, 0.0))
    yaw = wp.atan2(forward[1], forward[0])
    level = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -yaw) * q_base
    offset = wp.quat_rotate(level, mount_pos)
    turn = wp.quat_to_matrix(level * to_quat(mount_quat))
    for ray in range(true_ranges.shape[1]):
        if class_id[env, ray] == wanted_class:
            p = offset + true_ranges[env, ray] * (turn * directions[env, ray])
            distance = wp.sqrt(p[0] * p[0] + p[1] * p[1])
            sector = int(wp.floor((wp.atan2(p[1], p[0]) + PI) * float(num_sectors) / (2.0 * PI)))
            if sector >= num_sectors:
                sector = 0
            sector = wp.max(sector, 0)
            distances_out[env, sector] = wp.min(distances_out[env, sector], distance)
