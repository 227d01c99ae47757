"""One frame of a LiDAR, compiled for the shapes, the outputs and the noise that a sensor has."""

# ruff: noqa: UP018, SIM102  (in a kernel, wp.int32(0) and float(0) declare a variable that may change, and a branch on
# wp.static stands alone)

from dataclasses import dataclass

import warp as wp

from .field_block import walk_block
from .geometry import HEIGHTFIELD, INF, Geometry, shape_functions
from .motion import Moment, Track, Viewpoint, moment_at, to_quatd
from .noise import NoiseFigures, beside, child_key, disturb_function, jittered, mixed
from .search import Slots, locate_functions, search_function
from .variants import variants

NAN = wp.constant(wp.float32(float("nan")))
NO_BODY = wp.constant(-2)


@dataclass(frozen=True)
class ScanVariant:
    """What one compiled scan serves.

    Attributes:
        kinds: Kinds of shapes in the scene.
        outputs: Names of the fields of ``ScanOutputs`` that are written.
        noise: Names of the noise models.
        packed: Whether slots are searched by words.
        moving: Whether every ray is cast at its own time.
        displaced: Whether rays start beside the sensor's origin.
        selected: Whether the rays of a frame are listed, rather than every k-th row.
        shots: Whether several rows fire at one instant.
        walked: Whether a block's rays meet the scene's one height field all at once.
        pose_type: Of the bodies' poses, ``wp.float32`` or ``wp.float64``.
    """

    kinds: frozenset[int]
    outputs: frozenset[str]
    noise: frozenset[str]
    packed: bool
    moving: bool
    displaced: bool
    selected: bool
    shots: bool
    walked: bool
    pose_type: type


@wp.struct
class Rays:
    """Which rays a frame has; M rows of the table."""

    directions: wp.array(dtype=wp.vec3)  # (M,) unit vectors in the sensor frame
    origins: wp.array(dtype=wp.vec3)  # (M,) where rays start, if beside the sensor's origin
    angles: wp.array(dtype=wp.vec2)  # (M,) elevation and azimuth
    cycle: wp.int32  # rows before the table repeats
    start: wp.array2d(dtype=wp.int32)  # (num_envs, 2) the frame's first row: start of its cycle, steps into it
    offsets: wp.array2d(dtype=wp.int32)  # (V, N) rows after the first, if the rays are listed
    variant: wp.array(dtype=wp.int64)  # (num_envs,) which list
    first_row: wp.array(dtype=wp.int64)  # (num_envs,) the frame's first row in the pattern
    num_rows: wp.int32  # M
    stride: wp.int32  # rows of the pattern from ray to ray, if they are not listed
    lag: wp.array(dtype=wp.float32)  # (num_envs,) time of the first row after the frame's start, s
    seconds_per_row: wp.float32
    rows_per_shot: wp.int32
    period: wp.float32  # of a frame, s
    count: wp.int32  # rays per frame, N
    block: wp.int32  # rays per task
    num_blocks: wp.int32  # tasks per frame
    min_range: wp.float32
    max_range: wp.float32


@wp.struct
class Labels:
    """What is known of the shapes and of the sensor beside where they are."""

    body: wp.array(dtype=wp.int32)  # by shape
    reflectivity: wp.array(dtype=wp.float32)  # by class, times the square of the reference range, m^2
    frame: wp.array(dtype=wp.int32)  # (num_envs,) frames cast, for the noise


@wp.struct
class ScanOutputs:
    """(E, N) each, of E environments from the first one on; only those that the variant writes exist."""

    first_env: wp.int32
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
def turn_of(pose: wp.transformd):
    return wp.mat33(wp.quat_to_matrix(wp.transform_get_rotation(pose)))


@variants
def scan_kernel(variant: ScanVariant) -> wp.Kernel:
    """The kernel of one variant; a task casts ``Rays.block`` rays of one environment, one after the other."""
    outputs, noise = variant.outputs, variant.noise
    moving, displaced, selected, shots = variant.moving, variant.displaced, variant.selected, variant.shots
    walked = variant.walked
    search = search_function(variant.kinds, variant.packed, moving, displaced, walked)
    locate, _ = locate_functions(moving, displaced)
    normal_of = shape_functions(variant.kinds).normal
    disturb = disturb_function(noise)
    noisy, has_jitter, has_mixed = bool(noise), "jitter" in noise, "mixed" in noise
    in_base, in_world = "points_b" in outputs, "points_w" in outputs
    faces = bool(outputs & {"normals_w", "incidence", "intensity"})
    placed_at_end = not moving and bool(outputs & {"points_w", "normals_w"})
    timed = moving or "time_s" in outputs
    writes_ranges, writes_truth = "ranges" in outputs, "true_ranges" in outputs
    writes_valid, writes_points = "valid" in outputs, "points_s" in outputs
    writes_normals, writes_incidence = "normals_w" in outputs, "incidence" in outputs
    writes_intensity, writes_body = "intensity" in outputs, "body_id" in outputs
    writes_shape, writes_class = "shape_id" in outputs, "class_id" in outputs
    writes_time, writes_direction = "time_s" in outputs, "directions_s" in outputs
    writes_elevation, writes_azimuth, writes_row = "elevation" in outputs, "azimuth" in outputs, "row" in outputs
    vec3 = wp.types.vector(3, variant.pose_type)
    vec4 = wp.types.vector(4, variant.pose_type)

    @wp.kernel(module="unique", enable_backward=False)
    def cast_scan(
        task_offset: int,
        rays: Rays,
        viewpoint: Viewpoint,
        body_pos: wp.array2d(dtype=vec3),
        body_quat: wp.array2d(dtype=vec4),
        geometry: Geometry,
        slots: Slots,
        track: Track,
        labels: Labels,
        figures: NoiseFigures,
        out: ScanOutputs,
    ):
        """Casts a block of one environment's rays in the sensor's frame."""
        task = wp.tid() + task_offset
        env = task // rays.num_blocks
        out_env = env - out.first_env
        first = (task - env * rays.num_blocks) * rays.block
        last = wp.min(first + rays.block, rays.count)
        cycle = rays.start[env, 0]
        steps = rays.start[env, 1]
        moment = Moment()
        if wp.static(placed_at_end):
            moment.view = viewpoint.pose
            if viewpoint.body >= 0:
                p_carrier = wp.vec3d(body_pos[env, viewpoint.body])
                q_carrier = to_quatd(wp.vec4d(body_quat[env, viewpoint.body]))
                moment.view = wp.transformation(p_carrier, q_carrier) * viewpoint.pose
        turn_view = turn_of(moment.view)
        if wp.static(in_base):
            p_mount = wp.vec3(wp.transform_get_translation(viewpoint.pose))
            turn_mount = turn_of(viewpoint.pose)
        if wp.static(selected):
            listed = int(rays.variant[env])
        if wp.static(shots):
            into_shot = int(rays.first_row[env]) % rays.rows_per_shot
        if wp.static(noisy):
            env_key = child_key(child_key(wp.rand_init(figures.seed), env), labels.frame[env])
        if wp.static(walked):
            for s in range(slots.count[env]):
                field = slots.shape[env, s]
                if geometry.kind[field] == HEIGHTFIELD:
                    pose = slots.pose[env, s]
                    q = wp.transform_get_rotation(pose)
                    walk_block(
                        geometry.field_part[geometry.part[field]],
                        geometry.field_height,
                        geometry.field_window,
                        rays.directions,
                        cycle,
                        rays.cycle,
                        steps,
                        first,
                        last,
                        wp.quat_rotate_inv(q, -wp.transform_get_translation(pose)),
                        slots.axes[env, s],
                        rays.max_range,
                        env,
                        slots.walked_t,
                        slots.walked_slope,
                        slots.walked_face,
                    )
        for ray in range(first, last):
            at = steps + ray
            if wp.static(selected):
                at = steps + rays.offsets[listed, ray]
            if at >= rays.cycle:
                at = at % rays.cycle
            at += cycle
            d = rays.directions[at]
            cast_d = d
            if wp.static(timed):
                row_in_frame = ray * rays.stride
                if wp.static(selected):
                    row_in_frame = rays.offsets[listed, ray]
                if wp.static(shots):
                    row_in_frame = (row_in_frame + into_shot) // rays.rows_per_shot * rays.rows_per_shot - into_shot
                time = rays.lag[env] + float(row_in_frame) * rays.seconds_per_row
            if wp.static(moving):
                moment = moment_at(track, env, viewpoint, time / rays.period)
                turn_view = turn_of(moment.view)
            if wp.static(displaced):
                moment.origin = rays.origins[at]
            if wp.static(noisy):
                key = child_key(env_key, ray)
            if wp.static(has_jitter):
                cast_d = jittered(d, figures.jitter_sigma, key)
            met = search(geometry, slots, track, moment, env, ray, cast_d, rays.max_range)
            is_hit = met.slot >= 0 and met.t >= rays.min_range
            true_range = wp.where(is_hit, met.t, INF)
            measured = true_range
            if wp.static(noisy):
                if is_hit:
                    if wp.static(has_mixed):
                        second_d = beside(cast_d, figures.mixed_radius, at)
                        second = search(geometry, slots, track, moment, env, -1, second_d, rays.max_range)
                        if second.slot >= 0 and second.t >= rays.min_range:
                            measured = mixed(figures, measured, second.t)
                    measured = disturb(figures, measured, true_range, key)
            if wp.static(writes_ranges):
                out.ranges[out_env, ray] = measured
            if wp.static(writes_truth):
                out.true_ranges[out_env, ray] = true_range
            if wp.static(writes_valid):
                out.valid[out_env, ray] = measured < INF
            point = wp.vec3(NAN, NAN, NAN)
            if measured < INF:
                point = measured * d
                if wp.static(displaced):
                    point = point + moment.origin
            if wp.static(writes_points):
                out.points_s[out_env, ray] = point
            if wp.static(in_base):
                out.points_b[out_env, ray] = p_mount + turn_mount * point
            if wp.static(in_world):
                away = wp.vec3d(turn_view * point)
                out.points_w[out_env, ray] = wp.vec3(wp.transform_get_translation(moment.view) + away)
            shape = wp.int32(-1)
            if is_hit:
                shape = slots.shape[env, met.slot]
            if wp.static(writes_shape):
                out.shape_id[out_env, ray] = shape
            if wp.static(writes_class):
                class_id = wp.int32(-1)
                if is_hit:
                    class_id = geometry.class_id[shape]
                out.class_id[out_env, ray] = class_id
            if wp.static(writes_body):
                body_id = wp.int32(NO_BODY)
                if is_hit:
                    body_id = labels.body[shape]
                out.body_id[out_env, ray] = body_id
            if wp.static(faces):
                normal = wp.vec3(0.0, 0.0, 0.0)
                cosine = float(0.0)
                if is_hit:
                    met_at = locate(slots, track, moment, env, met.slot)
                    at_shape = met_at.axes * (true_range * cast_d - met_at.c)
                    normal = wp.transpose(met_at.axes) * normal_of(geometry, shape, env, met.face, at_shape)
                    cosine = wp.min(wp.abs(wp.dot(normal, cast_d)), 1.0)
                if wp.static(writes_normals):
                    out.normals_w[out_env, ray] = turn_view * normal
                if wp.static(writes_incidence):
                    out.incidence[out_env, ray] = wp.where(is_hit, wp.acos(cosine), NAN)
                if wp.static(writes_intensity):
                    intensity = float(0.0)
                    if is_hit:
                        intensity = labels.reflectivity[geometry.class_id[shape]] * cosine / (true_range * true_range)
                    out.intensity[out_env, ray] = intensity
            if wp.static(writes_time):
                out.time_s[out_env, ray] = time
            if wp.static(writes_direction):
                out.directions_s[out_env, ray] = d
            if wp.static(writes_elevation):
                out.elevation[out_env, ray] = rays.angles[at][0]
            if wp.static(writes_azimuth):
                out.azimuth[out_env, ray] = rays.angles[at][1]
            if wp.static(writes_row):
                row = int(rays.first_row[env]) + ray * rays.stride
                if wp.static(selected):
                    row = int(rays.first_row[env]) + rays.offsets[listed, ray]
                out.row[out_env, ray] = row % rays.num_rows

    return cast_scan
