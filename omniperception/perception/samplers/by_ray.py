"""Sampling with a thread for each ray, or each point that is written, instead of each environment: for GPUs.

One stable segmented sort (Warp's) puts the misses of every cloud first, then its proximal hits in ray order, then its
distal hits by (theta ring, phi). The points are those of `kernels`, bit for bit where both run on one device.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import warp as wp

from omniperception.common.launch import view
from omniperception.lidar.kernels.geometry import to_quat
from omniperception.lidar.kernels.sectors import levelled
from omniperception.perception.samplers.kernels import Scratch, is_hit, proximity_cell, proximity_point, sort_key

wp.set_module_options({"enable_backward": False})

MISS, PROXIMAL = wp.constant(-2), wp.constant(-1)
"""Sort keys of what is not distal."""
_LAST = wp.constant(0x7FFFFFFF)

USED_ON = ("cuda",)
"""Kinds of devices on which clouds are sampled so."""


class SortedRays:
    """Keys and items of clouds in the memory of a sampler's scratch, one run for each environment.

    Attributes:
        keys: (2 N L,) int32; the first half is sorted, the second is the sort's.
        items: likewise.
        parts: (N, 2) int32 where the proximal and the distal hits begin.
    """

    def __init__(self, tensors: dict[str, torch.Tensor], num_envs: int, length: int) -> None:
        """Args: tensors: the scratch's, see `PdSampler`; num_envs: N; length: L, of the runs."""
        self.count, self._num_envs, self._length = num_envs * length, num_envs, length
        keys, items = (tensors[name].view(-1)[: 2 * self.count] for name in ("keys", "items"))
        self.keys, self.items = view(keys, wp.int32), view(items, wp.int32)
        self.parts = view(tensors["parts"], wp.int32)
        self._device = keys.device

    def sort(self) -> None:
        """Sorts every run by its keys, in one launch on PyTorch's stream."""
        starts = view(_starts(self._num_envs, self._length, self._device), wp.int32)
        if self._device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
            with wp.ScopedStream(stream, sync_enter=False):
                wp.utils.segmented_sort_pairs(self.keys, self.items, self.count, starts)
        else:
            wp.utils.segmented_sort_pairs(self.keys, self.items, self.count, starts)


@lru_cache(64)
def _starts(num_envs: int, length: int, device: torch.device) -> torch.Tensor:
    """Where the runs begin, and where the last one ends."""
    return torch.arange(num_envs + 1, dtype=torch.int32, device=device) * length


@wp.kernel
def key_rays(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    elevation: wp.array2d(dtype=wp.float32),
    azimuth: wp.array2d(dtype=wp.float32),
    split: float,
    ring: float,
    # out
    keys_out: wp.array(dtype=wp.int32),
    items_out: wp.array(dtype=wp.int32),
):
    """What each ray is sorted by."""
    thread, ray = wp.tid()
    env = env_offset + thread
    theta = elevation[env, ray]
    key = wp.int32(MISS)
    if is_hit(ranges[env, ray]):
        if theta > split:
            key = PROXIMAL
        elif theta <= split:
            key = sort_key(theta, azimuth[env, ray], ring)
    at = env * ranges.shape[1] + ray
    keys_out[at] = key
    items_out[at] = ray


@wp.func
def first_from(keys: wp.array(dtype=wp.int32), start: int, end: int, key: int) -> int:
    """First place in the sorted run start..end-1 whose key is `key` or more, `end` without one."""
    low = wp.int32(start)
    high = wp.int32(end)
    while low < high:
        middle = low + (high - low) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def find_parts(
    env_offset: int,
    num_rays: int,
    keys: wp.array(dtype=wp.int32),
    # out
    parts_out: wp.array2d(dtype=wp.int32),
    num_proximal_out: wp.array(dtype=wp.int32),
):
    """Where each sorted cloud's proximal and distal hits begin."""
    env = env_offset + wp.tid()
    start = env * num_rays
    proximal = first_from(keys, start, start + num_rays, PROXIMAL)
    distal = first_from(keys, proximal, start + num_rays, 0)
    parts_out[env, 0] = proximal
    parts_out[env, 1] = distal
    num_proximal_out[env] = distal - proximal


@wp.kernel
def gather_ranked(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    scale: float,
    items: wp.array(dtype=wp.int32),
    parts: wp.array2d(dtype=wp.int32),
    scratch: Scratch,
):
    """Collects the proximal hits in ray order."""
    thread, k = wp.tid()
    env = env_offset + thread
    if k < scratch.num_proximal[env]:
        ray = items[parts[env, 0] + k]
        point = (ranges[env, ray] * scale) * directions[env, ray]
        scratch.x[env, k] = point[0]
        scratch.y[env, k] = point[1]
        scratch.z[env, k] = point[2]
        scratch.ray[env, k] = ray


@wp.kernel
def write_bins(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    scale: float,
    first_slot: int,
    num_bins: int,
    items: wp.array(dtype=wp.int32),
    parts: wp.array2d(dtype=wp.int32),
    # out
    points_out: wp.array2d(dtype=wp.vec3),
):
    """One point for each bin of consecutive distal hits; zeros where there are fewer hits than bins."""
    thread, b = wp.tid()
    env = env_offset + thread
    start = parts[env, 1]
    n = (env + 1) * ranges.shape[1] - start
    bins = wp.min(n, num_bins)
    point = wp.vec3(0.0, 0.0, 0.0)
    if b < bins:
        first = b * n // bins
        last = (b + 1) * n // bins
        for i in range(first, last):
            ray = items[start + i]
            point += (ranges[env, ray] * scale) * directions[env, ray]
        point = point / float(last - first)
    points_out[env, first_slot + b] = point


@wp.kernel
def key_picks(
    env_offset: int,
    elevation: wp.array2d(dtype=wp.float32),
    azimuth: wp.array2d(dtype=wp.float32),
    ring: float,
    num_picks: int,
    scratch: Scratch,
    # out
    keys_out: wp.array(dtype=wp.int32),
    items_out: wp.array(dtype=wp.int32),
):
    """What each picked point is sorted by; slots without one come last."""
    thread, i = wp.tid()
    env = env_offset + thread
    key = wp.int32(_LAST)
    item = wp.int32(0)
    if i < scratch.num_proximal[env]:
        item = scratch.picked[env, i]
        ray = scratch.ray[env, item]
        key = sort_key(elevation[env, ray], azimuth[env, ray], ring)
    keys_out[env * num_picks + i] = key
    items_out[env * num_picks + i] = item


@wp.kernel
def write_picks(
    env_offset: int,
    num_picks: int,
    items: wp.array(dtype=wp.int32),
    scratch: Scratch,
    # out
    points_out: wp.array2d(dtype=wp.vec3),
):
    """The sorted picked points, then zeros."""
    thread, i = wp.tid()
    env = env_offset + thread
    point = wp.vec3(0.0, 0.0, 0.0)
    if i < scratch.num_proximal[env]:
        p = items[env * num_picks + i]
        point = wp.vec3(scratch.x[env, p], scratch.y[env, p], scratch.z[env, p])
    points_out[env, i] = point


@wp.kernel
def find_nearest(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    elevation: wp.array2d(dtype=wp.float32),
    split: float,
    blind: float,
    base_quat: wp.array(dtype=wp.vec4),
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    body: wp.vec2,
    band_edges: wp.array(dtype=wp.float32),
    num_sectors: int,
    decay: float,
    scratch: Scratch,
    # out
    nearest_out: wp.array2d(dtype=wp.float32),
):
    """Each ray's proximity and cell, and the largest proximity of each cell, which has to be 0 before."""
    thread, ray = wp.tid()
    env = env_offset + thread
    distance = ranges[env, ray]
    cell = wp.int32(-1)
    proximity = wp.float32(0.0)
    if elevation[env, ray] <= split and is_hit(distance) and distance >= blind:
        level = levelled(base_quat[env])
        turn = wp.quat_to_matrix(level * to_quat(mount_quat))
        p = wp.quat_rotate(level, mount_pos) + distance * (turn * directions[env, ray])
        cell = proximity_cell(p, body, band_edges, num_sectors)
        if cell >= 0:
            proximity = wp.exp(-wp.sqrt(p[0] * p[0] + p[1] * p[1]) / decay)
            wp.atomic_max(nearest_out, env, cell, proximity)
    scratch.x[env, ray] = proximity
    scratch.ray[env, ray] = cell


@wp.kernel
def find_first(
    env_offset: int,
    scratch: Scratch,
    nearest: wp.array2d(dtype=wp.float32),
    # out
    first_out: wp.array2d(dtype=wp.int32),
):
    """The first ray of each cell that has its largest proximity; what is written has to be greater before."""
    thread, ray = wp.tid()
    env = env_offset + thread
    cell = scratch.ray[env, ray]
    if cell >= 0:  # noqa: SIM102  (a kernel reads both sides of an `and`)
        if scratch.x[env, ray] == nearest[env, cell]:
            wp.atomic_min(first_out, env, cell, ray)


@wp.kernel
def write_nearest(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    base_quat: wp.array(dtype=wp.vec4),
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    nearest: wp.array2d(dtype=wp.float32),
    first: wp.array2d(dtype=wp.int32),
    first_slot: int,
    # out
    points_out: wp.array2d(dtype=wp.vec3),
):
    """Bearing and proximity of each cell's nearest hit; zeros where there is none."""
    thread, cell = wp.tid()
    env = env_offset + thread
    point = wp.vec3(0.0, 0.0, 0.0)
    if nearest[env, cell] > 0.0:
        ray = first[env, cell]
        level = levelled(base_quat[env])
        turn = wp.quat_to_matrix(level * to_quat(mount_quat))
        p = wp.quat_rotate(level, mount_pos) + ranges[env, ray] * (turn * directions[env, ray])
        point = proximity_point(p, nearest[env, cell])
    points_out[env, first_slot + cell] = point
