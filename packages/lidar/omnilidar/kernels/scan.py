"""One frame of a LiDAR."""

# ruff: noqa: SIM102, UP018  (in a kernel, a branch on wp.static stands alone, and float(0) declares a variable that changes)

from functools import cache

import warp as wp

from .geometry import HEIGHTFIELD, INF, REFINE, Geometry, shape_functions
from .march_block import REACHES, march_block
from .motion import Moment, Track, Viewpoint, moment_at
from .noise import MODELS, NoiseParameters, beside, child_key, disturb_function, jittered, mixed
from .rotations import turn_of
from .search import search_functions
from .slots import Slots

NAN = wp.constant(wp.float32(float("nan")))
NO_BODY = wp.constant(-2)
WINDOW_REACHES = wp.constant(wp.vec4(*map(float, REACHES)))


@wp.struct
class Rays:
    """Rays of a frame; M rows of the table."""

    directions: wp.array(dtype=wp.vec3)  # (M,) unit vectors in the sensor frame
    origins: wp.array(dtype=wp.vec3)  # (M,) where rays start, if beside the sensor's origin
    angles: wp.array(dtype=wp.vec2)  # (M,) elevation and azimuth
    cycle: int  # rows before the table repeats
    start: wp.array2d(dtype=wp.int32)  # (num_envs, 2) the frame's first row: start of its cycle, steps into it
    offsets: wp.array2d(dtype=wp.int32)  # (V, N) rows after the first, if the rays are listed
    variant: wp.array(dtype=wp.int64)  # (num_envs,) which list
    first_row: wp.array(dtype=wp.int64)  # (num_envs,) the frame's first row in the pattern
    num_rows: int  # M
    stride: int  # rows of the pattern from ray to ray, if they are not listed
    lag: wp.array(dtype=wp.float32)  # (num_envs,) time of the first row after the frame's start, s
    seconds_per_row: float
    rows_per_shot: int
    period: float  # of a frame, s
    count: int  # rays per frame, N
    block: int  # rays per task
    num_blocks: int  # tasks per frame
    min_range: float
    max_range: float


@wp.struct
class Labels:
    """Tables of classes and environments."""

    reflectivity: wp.array(dtype=wp.float32)  # by class, times the square of the reference range, m^2
    frame: wp.array(dtype=wp.int32)  # (num_envs,) frames cast, for the noise


@wp.struct
class ScanOutputs:
    """(E, N) each, of E environments from the first one on; only those that are asked for exist."""

    first_env: int
    ranges: wp.array2d(dtype=wp.float32)
    true_ranges: wp.array2d(dtype=wp.float32)
    valid: wp.array2d(dtype=wp.bool)
    points_s: wp.array2d(dtype=wp.vec3)
    points_b: wp.array2d(dtype=wp.vec3)
    points_w: wp.array2d(dtype=wp.vec3)
    normals_w: wp.array2d(dtype=wp.vec3)
    incidence: wp.array2d(dtype=wp.float32)
    intensity: wp.array2d(dtype=wp.float32)
    body_id: wp.array2d(dtype=wp.int32)
    shape_id: wp.array2d(dtype=wp.int32)
    class_id: wp.array2d(dtype=wp.int32)
    time_s: wp.array2d(dtype=wp.float32)
    directions_s: wp.array2d(dtype=wp.vec3)
    elevation: wp.array2d(dtype=wp.float32)
    azimuth: wp.array2d(dtype=wp.float32)
    row: wp.array2d(dtype=wp.int32)


@wp.func
def start_of_shot(row: int, first_row: int, rows_per_shot: int):
    """First row of a row's shot; both count from the frame's first row, which is ``first_row`` of the pattern."""
    start = row
    if rows_per_shot > 1:
        into_shot = first_row % rows_per_shot
        start = (row + into_shot) // rows_per_shot * rows_per_shot - into_shot
    return start


@wp.func
def march_height_field(rays: Rays, geometry: Geometry, slots: Slots, env: int, first: int, last: int):
    """Notes in ``slots`` what a block of rays hits of the scene's one height field."""
    for s in range(slots.count[env]):
        shape = slots.shape[env, s]
        if geometry.kind[shape] == HEIGHTFIELD:
            pose = slots.pose[env, s]
            march_block(
                geometry.field_part[geometry.part[shape]],
                geometry.field_height,
                geometry.field_window,
                WINDOW_REACHES,
                rays.directions,
                rays.start[env, 0],
                rays.cycle,
                rays.start[env, 1],
                first,
                last,
                wp.quat_rotate_inv(wp.transform_get_rotation(pose), -wp.transform_get_translation(pose)),
                slots.axes[env, s],
                rays.max_range,
                REFINE,
                env,
                slots.marched_t,
                slots.marched_face,
                slots.marched_uncertain,
            )
    return 0


@cache
def scan_kernel(has: frozenset[str]) -> wp.Kernel:
    """The kernel for what a sensor has; everything else is not in its code and costs no time.

    Args:
        has: Names of outputs (fields of ``ScanOutputs``), of noise models, and out of "motion" (each ray is cast at its
            own time), "origins" (rays start beside the sensor's origin), "offsets" (rays are listed), "mesh" and
            "heightfield" (the scene has such shapes) and "marched" (blocks of rays march through its one height field).
    """
    search, locate = search_functions(has & {"motion", "origins", "mesh", "heightfield", "marched"})
    _, _, shape_normal = shape_functions("mesh" in has, "heightfield" in has)
    disturb, noisy = disturb_function(has & MODELS), bool(has & MODELS)
    has_point = bool(has & {"points_s", "points_b", "points_w"})
    has_label = bool(has & {"body_id", "shape_id", "class_id"})
    has_normal = bool(has & {"normals_w", "incidence", "intensity"})
    has_view = "motion" not in has and bool(has & {"points_w", "normals_w"})
    is_timed = bool(has & {"motion", "time_s"})

    @wp.kernel(module="unique", enable_backward=False)
    def cast_scan(
        task_offset: int,
        # sensor
        rays: Rays,
        viewpoint: Viewpoint,
        noise: NoiseParameters,
        # scene
        geometry: Geometry,
        slots: Slots,
        track: Track,
        labels: Labels,
        # out
        out: ScanOutputs,
    ):
        """Casts a block of one environment's rays, one after the other, in the sensor's frame.

        A ray is found in the scan table, turned by jitter, cast at its own time where things move, disturbed by noise,
        and written to the outputs.
        """
        task = wp.tid() + task_offset
        env = task // rays.num_blocks
        out_env = env - out.first_env
        first = (task - env * rays.num_blocks) * rays.block
        last = wp.min(first + rays.block, rays.count)
        cycle = rays.start[env, 0]
        steps = rays.start[env, 1]
        moment = Moment()
        if wp.static(has_view):
            moment.view = slots.view[env]
        turn_view = turn_of(moment.view)
        if wp.static("points_b" in has):
            p_mount = wp.vec3(wp.transform_get_translation(viewpoint.pose))
            turn_mount = turn_of(viewpoint.pose)
        if wp.static(noisy):
            env_key = child_key(child_key(wp.rand_init(noise.seed[env]), noise.stream[env]), labels.frame[env])
        if wp.static("marched" in has):
            march_height_field(rays, geometry, slots, env, first, last)

        for ray in range(first, last):
            # place in the scan table, and rows of the pattern since the frame's first
            row = ray * rays.stride
            at = steps + ray
            if wp.static("offsets" in has):
                row = rays.offsets[int(rays.variant[env]), ray]
                at = steps + row
            if at >= rays.cycle:
                at = at % rays.cycle
            at += cycle

            # the ray, at its own time
            d = rays.directions[at]
            cast_d = d
            if wp.static("origins" in has):
                moment.origin = rays.origins[at]
            if wp.static(is_timed):
                shot_row = start_of_shot(row, int(rays.first_row[env]), rays.rows_per_shot)
                time = rays.lag[env] + float(shot_row) * rays.seconds_per_row
            if wp.static("motion" in has):
                now = moment_at(track, env, viewpoint, time / rays.period)
                now.origin = moment.origin
                moment = now
                turn_view = turn_of(moment.view)
            if wp.static(noisy):
                key = child_key(env_key, ray)
            if wp.static("jitter" in has):
                cast_d = jittered(d, noise.jitter_sigma, key)

            # distance
            hit = search(geometry, slots, track, moment, env, ray, cast_d, rays.max_range)
            is_hit = hit.slot >= 0 and hit.t >= rays.min_range
            true_range = wp.where(is_hit, hit.t, INF)
            measured = true_range
            if wp.static(noisy):
                if is_hit:
                    if wp.static("mixed" in has):
                        side = (rays.first_row[env] + wp.int64(row)) % wp.int64(rays.num_rows)
                        second_d = beside(cast_d, noise.mixed_radius, int(side))
                        second = search(geometry, slots, track, moment, env, -1, second_d, rays.max_range)
                        if second.slot >= 0 and second.t >= rays.min_range:
                            measured = mixed(noise, measured, second.t)
                    measured = disturb(noise, measured, true_range, key)
            if wp.static("ranges" in has):
                out.ranges[out_env, ray] = measured
            if wp.static("true_ranges" in has):
                out.true_ranges[out_env, ray] = true_range
            if wp.static("valid" in has):
                out.valid[out_env, ray] = measured < INF

            # measured point
            if wp.static(has_point):
                point = wp.vec3(NAN, NAN, NAN)
                if measured < INF:
                    point = measured * d
                    if wp.static("origins" in has):
                        point = point + moment.origin
                if wp.static("points_s" in has):
                    out.points_s[out_env, ray] = point
                if wp.static("points_b" in has):
                    out.points_b[out_env, ray] = p_mount + turn_mount * point
                if wp.static("points_w" in has):
                    away = wp.vec3d(turn_view * point)
                    out.points_w[out_env, ray] = wp.vec3(wp.transform_get_translation(moment.view) + away)

            # what was hit
            if wp.static(has_label or has_normal):
                shape = wp.int32(-1)
                if is_hit:
                    shape = slots.shape[env, hit.slot]
            if wp.static("shape_id" in has):
                out.shape_id[out_env, ray] = shape
            if wp.static("class_id" in has):
                class_id = wp.int32(-1)
                if is_hit:
                    class_id = geometry.class_id[shape]
                out.class_id[out_env, ray] = class_id
            if wp.static("body_id" in has):
                body_id = wp.int32(NO_BODY)
                if is_hit:
                    body_id = geometry.body[shape]
                out.body_id[out_env, ray] = body_id

            # surface
            if wp.static(has_normal):
                normal = wp.vec3(0.0, 0.0, 0.0)
                cosine = float(0.0)
                if is_hit:
                    on = locate(slots, track, moment, env, hit.slot)
                    point_of_shape = on.axes * (true_range * cast_d - on.c)
                    normal = wp.transpose(on.axes) * shape_normal(geometry, shape, env, hit.face, point_of_shape)
                    cosine = wp.min(wp.abs(wp.dot(normal, cast_d)), 1.0)
                if wp.static("normals_w" in has):
                    out.normals_w[out_env, ray] = turn_view * normal
                if wp.static("incidence" in has):
                    out.incidence[out_env, ray] = wp.where(is_hit, wp.acos(cosine), NAN)
                if wp.static("intensity" in has):
                    intensity = float(0.0)
                    if is_hit:
                        intensity = labels.reflectivity[geometry.class_id[shape]] * cosine / (true_range * true_range)
                    out.intensity[out_env, ray] = intensity

            # the ray itself
            if wp.static("time_s" in has):
                out.time_s[out_env, ray] = time
            if wp.static("directions_s" in has):
                out.directions_s[out_env, ray] = d
            if wp.static("elevation" in has):
                out.elevation[out_env, ray] = rays.angles[at][0]
            if wp.static("azimuth" in has):
                out.azimuth[out_env, ray] = rays.angles[at][1]
            if wp.static("row" in has):
                out.row[out_env, ray] = (int(rays.first_row[env]) + row) % rays.num_rows

    return cast_scan
