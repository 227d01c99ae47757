"""Warp kernels of the samplers, for all devices.

A kernel is launched over (N, lanes): the lanes share the rays, points or cells of an environment, lane i taking
i, i + lanes, ... A CPU has one lane, a GPU many (:data:`LANES`). Only :mod:`sorting` has a form for each kind of
device.
"""

from pathlib import Path

import warp as wp

from omnilidar.kernels.rotations import to_quat
from omnilidar.kernels.sectors import levelled, sector_of
from omnilidar.native import function_body

wp.set_module_options({"enable_backward": False})

PHI_BITS = 16
MAX_RING = (1 << (31 - PHI_BITS)) - 1
"""Largest ring index that fits a sort key of 31 bits beside the quantised azimuth."""
BUCKET_SIZE = 32
"""Points per bucket of ``farthest_points_by_bucket``."""
WORDS_PER_BUCKET = 5 * BUCKET_SIZE + 7
"""Work memory of a bucket: five numbers for each point, its box, and its largest distance."""

LANES = {"cpu": 1, "cuda": 128}
"""Threads that share one environment, by kind of device."""
BLOCK = {"cpu": 1, "cuda": 128}
"""The same where they synchronise: a CUDA block, or one thread."""

_HERE = Path(__file__).parent
_HALF_PI = wp.constant(1.5707963267948966)
_PI = wp.constant(3.141592653589793)
_LAST_RAY = wp.constant(wp.int64(0x7FFFFFFF))


@wp.struct
class Work:
    """Work memory of one sampler: N environments, R rays, K points to pick; a row for each environment."""

    rays: wp.array2d(dtype=wp.int32)  # (N, R) rays in sampling order, see `sorting`
    parts: wp.array2d(dtype=wp.int32)  # (N, 3) where in it the proximal hits begin, the distal hits begin, and they end
    x: wp.array2d(dtype=wp.float32)  # (N, R) coordinates of the proximal hits / max range
    y: wp.array2d(dtype=wp.float32)
    z: wp.array2d(dtype=wp.float32)
    distance: wp.array2d(dtype=wp.int32)  # (N, R) bits of the squared distance to the nearest picked point
    buckets: wp.array2d(dtype=wp.int32)  # (N, WORDS_PER_BUCKET * buckets)
    picked: wp.array2d(dtype=wp.int32)  # (N, K) positions in x, y, z
    picked_keys: wp.array2d(dtype=wp.int32)  # (N, K) what the picked points are sorted by
    keys: wp.array3d(dtype=wp.int32)  # (2, N, R) sort keys of rays, twice because a sort writes from half to half
    items: wp.array3d(dtype=wp.int32)  # (2, N, R) rays that are sorted by them
    histogram: wp.array2d(dtype=wp.int32)  # (N, RADIX_SIZE)


@wp.func_native(function_body(_HERE / "farthest_points.h"))
def farthest_points(
    x: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
    z: wp.array2d(dtype=wp.float32),
    distance: wp.array2d(dtype=wp.int32),
    picked: wp.array2d(dtype=wp.int32),
    n: int,
    num_picks: int,
    env: int,
    lane: int,
    num_lanes: int,
): ...


@wp.func_native(function_body(_HERE / "farthest_points_by_bucket.h"))
def farthest_points_by_bucket(
    x: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
    z: wp.array2d(dtype=wp.float32),
    picked: wp.array2d(dtype=wp.int32),
    work: wp.array2d(dtype=wp.int32),
    n: int,
    num_picks: int,
    env: int,
): ...


@wp.func_native(function_body(_HERE / "rank.h"))
def rank_of(keys: wp.array2d(dtype=wp.int32), env: int, i: int, n: int) -> int: ...


@wp.func
def is_hit(distance: float) -> bool:
    """A miss is infinite; a non-finite range is never a point."""
    return wp.isfinite(distance)


@wp.func
def sort_key(theta: float, phi: float, ring: float) -> int:
    """(theta ring, phi) as one integer: ring index above PHI_BITS bits of azimuth counted from -pi."""
    row = wp.clamp(int(wp.floor((theta + _HALF_PI) / ring)), 0, MAX_RING)
    turn = (phi + _PI) / (2.0 * _PI)
    turn -= wp.floor(turn)
    column = wp.min(int(turn * float(1 << PHI_BITS)), (1 << PHI_BITS) - 1)
    return (row << PHI_BITS) | column


@wp.kernel
def write_raw(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    scale: float,
    num_lanes: int,
    # out
    points_out: wp.array2d(dtype=wp.vec3),
):
    """Every ray's point; a miss is zero."""
    thread, lane = wp.tid()
    env = env_offset + thread
    for ray in range(lane, ranges.shape[1], num_lanes):
        point = wp.vec3(0.0, 0.0, 0.0)
        if is_hit(ranges[env, ray]):
            point = (ranges[env, ray] * scale) * directions[env, ray]
        points_out[env, ray] = point


@wp.kernel
def pick_farthest(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    elevation: wp.array2d(dtype=wp.float32),
    azimuth: wp.array2d(dtype=wp.float32),
    scale: float,
    ring: float,
    num_picks: int,
    num_lanes: int,
    buckets_from: int,
    work: Work,
):
    """Exact farthest point sampling of the proximal hits from the first in ray order; no point is picked twice.

    A single lane sorts ``buckets_from`` points and more into buckets.
    """
    thread, lane = wp.tid()
    env = env_offset + thread
    first = work.parts[env, 0]
    n = work.parts[env, 1] - first
    for i in range(lane, n, num_lanes):
        ray = work.rays[env, first + i]
        point = (ranges[env, ray] * scale) * directions[env, ray]
        work.x[env, i] = point[0]
        work.y[env, i] = point[1]
        work.z[env, i] = point[2]
    if num_lanes == 1 and n >= buckets_from and n > num_picks:
        farthest_points_by_bucket(work.x, work.y, work.z, work.picked, work.buckets, n, num_picks, env)
    else:
        farthest_points(work.x, work.y, work.z, work.distance, work.picked, n, num_picks, env, lane, num_lanes)
    for i in range(lane, wp.min(n, num_picks), num_lanes):
        ray = work.rays[env, first + work.picked[env, i]]
        work.picked_keys[env, i] = sort_key(elevation[env, ray], azimuth[env, ray], ring)


@wp.kernel
def write_picked(env_offset: int, num_picks: int, num_lanes: int, work: Work, points_out: wp.array2d(dtype=wp.vec3)):
    """The picked points sorted by key, of equal keys the first picked first, then zeros."""
    thread, lane = wp.tid()
    env = env_offset + thread
    n = wp.min(work.parts[env, 1] - work.parts[env, 0], num_picks)
    for i in range(lane, num_picks, num_lanes):
        if i < n:
            p = work.picked[env, i]
            points_out[env, rank_of(work.picked_keys, env, i, n)] = wp.vec3(
                work.x[env, p], work.y[env, p], work.z[env, p]
            )
        else:
            points_out[env, i] = wp.vec3(0.0, 0.0, 0.0)


@wp.kernel
def write_bins(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    scale: float,
    first_slot: int,
    num_bins: int,
    num_lanes: int,
    work: Work,
    # out
    points_out: wp.array2d(dtype=wp.vec3),
):
    """The mean of each bin of consecutive distal hits; zeros where there are fewer hits than bins."""
    thread, lane = wp.tid()
    env = env_offset + thread
    start = work.parts[env, 1]
    n = work.parts[env, 2] - start
    bins = wp.min(n, num_bins)
    for b in range(lane, num_bins, num_lanes):
        point = wp.vec3(0.0, 0.0, 0.0)
        if b < bins:
            first = b * n // bins
            last = (b + 1) * n // bins
            for i in range(first, last):
                ray = work.rays[env, start + i]
                point += (ranges[env, ray] * scale) * directions[env, ray]
            point = point / float(last - first)
        points_out[env, first_slot + b] = point


@wp.func
def proximity_cell(p: wp.vec3, body: wp.vec2, band_edges: wp.array(dtype=wp.float32), num_sectors: int) -> int:
    """Band and sector of a point around the levelled base; -1 on the body and outside of all bands."""
    num_bands = band_edges.shape[0] - 1
    on_body = wp.abs(p[0]) < body[0] and wp.abs(p[1]) < body[1]
    if on_body or p[2] < band_edges[0] or p[2] >= band_edges[num_bands]:
        return -1
    band = wp.int32(0)
    while p[2] >= band_edges[band + 1]:
        band += 1
    return band * num_sectors + sector_of(p[0], p[1], num_sectors)


@wp.func
def nearest_key(proximity: float, ray: int) -> wp.int64:
    """A number that is larger for a larger proximity, which is not negative, and of equal ones for the first ray."""
    bits = wp.int64(wp.cast(proximity, wp.int32))
    return (bits << wp.int64(32)) | (_LAST_RAY - wp.int64(ray))


@wp.kernel
def find_nearest(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    base_quat: wp.array(dtype=wp.vec4),  # (w, x, y, z)
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    elevation: wp.array2d(dtype=wp.float32),
    split: float,
    blind: float,
    body: wp.vec2,
    band_edges: wp.array(dtype=wp.float32),
    num_sectors: int,
    decay: float,
    num_lanes: int,
    # out
    nearest_out: wp.array2d(dtype=wp.int64),
):
    """The distal hit with the largest proximity in each cell, see `nearest_key`; cells have to be 0 before."""
    thread, lane = wp.tid()
    env = env_offset + thread
    level = levelled(base_quat[env])
    offset = wp.quat_rotate(level, mount_pos)
    turn = wp.quat_to_matrix(level * to_quat(mount_quat))
    for ray in range(lane, ranges.shape[1], num_lanes):
        distance = ranges[env, ray]
        if elevation[env, ray] <= split and is_hit(distance) and distance >= blind:
            p = offset + distance * (turn * directions[env, ray])
            cell = proximity_cell(p, body, band_edges, num_sectors)
            if cell >= 0:
                proximity = wp.exp(-wp.sqrt(p[0] * p[0] + p[1] * p[1]) / decay)
                wp.atomic_max(nearest_out, env, cell, nearest_key(proximity, ray))


@wp.kernel
def write_nearest(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    base_quat: wp.array(dtype=wp.vec4),  # (w, x, y, z)
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    nearest: wp.array2d(dtype=wp.int64),
    first_slot: int,
    num_lanes: int,
    # out
    points_out: wp.array2d(dtype=wp.vec3),
):
    """Bearing of each cell's nearest hit times its proximity, and that itself; zeros without one."""
    thread, lane = wp.tid()
    env = env_offset + thread
    level = levelled(base_quat[env])
    offset = wp.quat_rotate(level, mount_pos)
    turn = wp.quat_to_matrix(level * to_quat(mount_quat))
    for cell in range(lane, nearest.shape[1], num_lanes):
        key = nearest[env, cell]
        point = wp.vec3(0.0, 0.0, 0.0)
        if key > wp.int64(0):
            proximity = wp.cast(wp.int32(key >> wp.int64(32)), wp.float32)
            ray = wp.int32(_LAST_RAY - (key & _LAST_RAY))
            p = offset + ranges[env, ray] * (turn * directions[env, ray])
            bearing = proximity / wp.max(wp.sqrt(p[0] * p[0] + p[1] * p[1]), 1.0e-6)
            point = wp.vec3(bearing * p[0], bearing * p[1], proximity)
        points_out[env, first_slot + cell] = point
