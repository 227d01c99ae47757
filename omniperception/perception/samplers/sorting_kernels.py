"""Warp kernels of the order of rays, see :mod:`sorting`."""

import warp as wp

from omniperception.perception.samplers.kernels import Work, is_hit, sort_key

wp.set_module_options({"enable_backward": False})

RADIX_BITS = 8
RADIX_SIZE = 1 << RADIX_BITS

_MISS, _PROXIMAL = wp.constant(-2), wp.constant(-1)
"""Sort keys of what is not distal."""


@wp.kernel
def sort_each_environment(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    elevation: wp.array2d(dtype=wp.float32),
    azimuth: wp.array2d(dtype=wp.float32),
    split: float,
    ring: float,
    has_distal: int,
    work: Work,
):
    """A stable radix sort of the distal hits, for CPUs."""
    env = env_offset + wp.tid()
    num_proximal = wp.int32(0)
    n = wp.int32(0)
    for ray in range(ranges.shape[1]):
        if is_hit(ranges[env, ray]):
            theta = elevation[env, ray]
            if theta > split:
                work.rays[env, num_proximal] = ray
                num_proximal += 1
            elif has_distal != 0 and theta <= split:
                work.keys[0, env, n] = sort_key(theta, azimuth[env, ray], ring)
                work.items[0, env, n] = ray
                n += 1
    half = radix_sort(env, n, work)
    for i in range(n):
        work.rays[env, num_proximal + i] = work.items[half, env, i]
    work.parts[env, 0] = 0
    work.parts[env, 1] = num_proximal
    work.parts[env, 2] = num_proximal + n


@wp.func
def radix_sort(env: int, n: int, work: Work) -> int:
    """Stable sort of the first n items of half 0 by key; returns the half that holds the result."""
    half = wp.int32(0)
    for digit in range(4):
        shift = digit * RADIX_BITS
        for b in range(RADIX_SIZE):
            work.histogram[env, b] = 0
        for i in range(n):
            b = (work.keys[half, env, i] >> shift) & (RADIX_SIZE - 1)
            work.histogram[env, b] = work.histogram[env, b] + 1
        first = wp.int32(0)
        if n > 0:
            first = (work.keys[half, env, 0] >> shift) & (RADIX_SIZE - 1)
        if work.histogram[env, first] < n:  # otherwise this digit is the same everywhere
            start = wp.int32(0)
            for b in range(RADIX_SIZE):
                count = work.histogram[env, b]
                work.histogram[env, b] = start
                start += count
            for i in range(n):
                key = work.keys[half, env, i]
                b = (key >> shift) & (RADIX_SIZE - 1)
                slot = work.histogram[env, b]
                work.histogram[env, b] = slot + 1
                work.keys[1 - half, env, slot] = key
                work.items[1 - half, env, slot] = work.items[half, env, i]
            half = 1 - half
    return half


@wp.kernel
def key_rays(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    elevation: wp.array2d(dtype=wp.float32),
    azimuth: wp.array2d(dtype=wp.float32),
    split: float,
    ring: float,
    has_distal: int,
    num_lanes: int,
    work: Work,
):
    """Key by which each ray is sorted: misses, and distal hits that are not used, come first."""
    thread, lane = wp.tid()
    env = env_offset + thread
    for ray in range(lane, ranges.shape[1], num_lanes):
        theta = elevation[env, ray]
        key = wp.int32(_MISS)
        if is_hit(ranges[env, ray]):
            if theta > split:
                key = _PROXIMAL
            elif has_distal != 0 and theta <= split:
                key = sort_key(theta, azimuth[env, ray], ring)
        work.keys[0, env, ray] = key
        work.items[0, env, ray] = ray


@wp.kernel
def find_parts(env_offset: int, work: Work):
    """Begin of each sorted row's proximal and distal hits."""
    env = env_offset + wp.tid()
    num_rays = work.rays.shape[1]
    proximal = first_from(work.keys, env, 0, num_rays, _PROXIMAL)
    work.parts[env, 0] = proximal
    work.parts[env, 1] = first_from(work.keys, env, proximal, num_rays, 0)
    work.parts[env, 2] = num_rays


@wp.func
def first_from(keys: wp.array3d(dtype=wp.int32), env: int, start: int, end: int, key: int) -> int:
    """First place in the sorted run start..end-1 of a row whose key is `key` or more, `end` without one."""
    low = wp.int32(start)
    high = wp.int32(end)
    while low < high:
        middle = low + (high - low) // 2
        if keys[0, env, middle] < key:
            low = middle + 1
        else:
            high = middle
    return low
