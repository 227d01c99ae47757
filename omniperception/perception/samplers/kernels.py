"""Warp kernels of the point-cloud samplers: partition, farthest points, sorting and averaging, one source for
all devices."""

import warp as wp

from omniperception.lidar.kernels.geometry import to_quat
from omniperception.lidar.kernels.sectors import levelled

wp.set_module_options({"enable_backward": False})

RADIX_BITS = 8
RADIX_SIZE = 1 << RADIX_BITS
PHI_BITS = 16
MAX_RING = (1 << (31 - PHI_BITS)) - 1
"""Largest ring index that fits a sort key of 31 bits beside the quantised azimuth."""

_HALF_PI = wp.constant(1.5707963267948966)
_PI = wp.constant(3.141592653589793)


@wp.struct
class Scratch:
    """Work memory of one sampler; N environments, R rays, K points to pick, arrays one row per
    environment."""

    x: wp.array2d(dtype=wp.float32)  # (N, R) coordinates of the proximal hits / max range
    y: wp.array2d(dtype=wp.float32)
    z: wp.array2d(dtype=wp.float32)
    ray: wp.array2d(dtype=wp.int32)  # (N, R) ray index of each proximal hit
    distance: wp.array2d(dtype=wp.int32)  # (N, R) bits of the squared distance to the picked points
    picked: wp.array2d(dtype=wp.int32)  # (N, K) positions in x, y, z
    num_proximal: wp.array(dtype=wp.int32)  # (N,) proximal hits
    keys: wp.array3d(dtype=wp.int32)  # (2, N, R) sort keys, read from one half and written to the other
    items: wp.array3d(dtype=wp.int32)  # (2, N, R) what is sorted by them
    histogram: wp.array2d(dtype=wp.int32)  # (N, RADIX_SIZE)
    bucketed: wp.array3d(dtype=wp.float32)  # (N, 3, R rounded up to whole buckets) x, y, z in order of place
    position: wp.array2d(dtype=wp.int32)  # (N, the same) their positions in x, y, z
    boxes: wp.array3d(dtype=wp.float32)  # (N, 6, buckets) least x, y, z and greatest x, y, z of each bucket
    bucket_distance: wp.array2d(dtype=wp.int32)  # (N, buckets) greatest distance bits in each bucket


BUCKET_SIZE = 32
"""Points per bucket of :func:`farthest_points_by_bucket`."""

_FARTHEST_POINTS_BY_BUCKET = r"""
#if !defined(__CUDA_ARCH__)
    const int SIZE = 32, CELLS = 16;
    const int n = num_proximal.data[env];
    const int buckets = (n + SIZE - 1) / SIZE, padded = buckets * SIZE;
    const float* in[3] = {
        (const float*)((const char*)x.data + (size_t)env * x.strides[0]),
        (const float*)((const char*)y.data + (size_t)env * y.strides[0]),
        (const float*)((const char*)z.data + (size_t)env * z.strides[0])};
    float* sorted[3];
    float* low[3];
    float* high[3];
    for (int a = 0; a < 3; ++a) {
        sorted[a] = (float*)((char*)bucketed.data + (size_t)env * bucketed.strides[0] + a * bucketed.strides[1]);
        low[a] = (float*)((char*)boxes.data + (size_t)env * boxes.strides[0] + a * boxes.strides[1]);
        high[a] = (float*)((char*)boxes.data + (size_t)env * boxes.strides[0] + (a + 3) * boxes.strides[1]);
    }
    const float* __restrict__ X = sorted[0];
    const float* __restrict__ Y = sorted[1];
    const float* __restrict__ Z = sorted[2];
    int* __restrict__ I = (int*)((char*)position.data + (size_t)env * position.strides[0]);
    int* __restrict__ D = (int*)((char*)distance.data + (size_t)env * distance.strides[0]);
    int* __restrict__ M = (int*)((char*)bucket_distance.data + (size_t)env * bucket_distance.strides[0]);
    int* __restrict__ P = (int*)((char*)picked.data + (size_t)env * picked.strides[0]);

    // Order by cell of a grid over the cloud, along a Z-curve, so that consecutive points are near each other.
    float least[3], scale[3];
    for (int a = 0; a < 3; ++a) {
        float lo = in[a][0], hi = in[a][0];
        for (int i = 1; i < n; ++i) {
            lo = in[a][i] < lo ? in[a][i] : lo;
            hi = in[a][i] > hi ? in[a][i] : hi;
        }
        least[a] = lo;
        scale[a] = hi > lo ? (float)CELLS / (hi - lo) : 0.0f;
    }
    static const unsigned short SPREAD[16] = {
        0, 1, 8, 9, 64, 65, 72, 73, 512, 513, 520, 521, 576, 577, 584, 585};
    int starts[4097];
    for (int c = 0; c <= 4096; ++c) starts[c] = 0;
    for (int i = 0; i < n; ++i) {
        int key = 0;
        for (int a = 0; a < 3; ++a) {
            int cell = (int)((in[a][i] - least[a]) * scale[a]);
            cell = cell < 0 ? 0 : (cell > CELLS - 1 ? CELLS - 1 : cell);
            key |= SPREAD[cell] << a;
        }
        D[i] = key;
        ++starts[key + 1];
    }
    for (int c = 0; c < 4096; ++c) starts[c + 1] += starts[c];
    int current = 0;
    for (int i = 0; i < n; ++i) {
        const int slot = starts[D[i]]++;
        if (i == 0) current = slot;
        I[slot] = i;
        for (int a = 0; a < 3; ++a) sorted[a][slot] = in[a][i];
    }
    for (int i = n; i < padded; ++i) {
        I[i] = 0x7fffffff;
        for (int a = 0; a < 3; ++a) sorted[a][i] = sorted[a][n - 1];
    }
    for (int i = 0; i < padded; ++i) D[i] = i < n ? 0x7f7fffff : -1;
    for (int b = 0; b < buckets; ++b) {
        M[b] = 0x7f7fffff;
        for (int a = 0; a < 3; ++a) {
            float lo = sorted[a][b * SIZE], hi = lo;
            for (int i = b * SIZE + 1; i < (b + 1) * SIZE; ++i) {
                lo = sorted[a][i] < lo ? sorted[a][i] : lo;
                hi = sorted[a][i] > hi ? sorted[a][i] : hi;
            }
            low[a][b] = lo;
            high[a][b] = hi;
        }
    }
    const float* __restrict__ LX = low[0];
    const float* __restrict__ LY = low[1];
    const float* __restrict__ LZ = low[2];
    const float* __restrict__ HX = high[0];
    const float* __restrict__ HY = high[1];
    const float* __restrict__ HZ = high[2];
    for (int s = 0; s < num_picks; ++s) {
        P[s] = I[current];
        if (s == num_picks - 1) return;
        D[current] = -1;
        const int own = current / SIZE;
        const float cx = X[current], cy = Y[current], cz = Z[current];
        // A block of buckets at a time: those whose box is nearer than their farthest point must look at their points.
        for (int first = 0; first < buckets; first += 16) {
            const int last = first + 16 < buckets ? first + 16 : buckets;
            int looks[16];
            int any = 0;
            for (int b = first; b < last; ++b) {
                float dx = LX[b] - cx > cx - HX[b] ? LX[b] - cx : cx - HX[b];
                float dy = LY[b] - cy > cy - HY[b] ? LY[b] - cy : cy - HY[b];
                float dz = LZ[b] - cz > cz - HZ[b] ? LZ[b] - cz : cz - HZ[b];
                dx = dx > 0.0f ? dx : 0.0f;
                dy = dy > 0.0f ? dy : 0.0f;
                dz = dz > 0.0f ? dz : 0.0f;
                const float squared = dx * dx + dy * dy + dz * dz;
                int bits;
                memcpy(&bits, &squared, sizeof(bits));
                looks[b - first] = bits < M[b] || b == own;
                any |= looks[b - first];
            }
            if (!any) continue;
            for (int b = first; b < last; ++b) {
                if (!looks[b - first]) continue;
                int farthest = -1;
                for (int i = b * SIZE; i < (b + 1) * SIZE; ++i) {
                    const float dx = X[i] - cx, dy = Y[i] - cy, dz = Z[i] - cz;
                    const float squared = dx * dx + dy * dy + dz * dz;
                    int bits;
                    memcpy(&bits, &squared, sizeof(bits));
                    const int d = D[i] < bits ? D[i] : bits;
                    D[i] = d;
                    farthest = farthest > d ? farthest : d;
                }
                M[b] = farthest;
            }
        }
        int farthest = -1;
        for (int b = 0; b < buckets; ++b) farthest = farthest > M[b] ? farthest : M[b];
        int winner = 0x7fffffff;
        for (int b = 0; b < buckets; ++b) {
            if (M[b] != farthest) continue;
            for (int i = b * SIZE; i < (b + 1) * SIZE; ++i) {
                if (D[i] == farthest && I[i] < winner) { winner = I[i]; current = i; }
            }
        }
    }
#endif
"""


@wp.func_native(_FARTHEST_POINTS_BY_BUCKET)
def farthest_points_by_bucket(
    x: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
    z: wp.array2d(dtype=wp.float32),
    distance: wp.array2d(dtype=wp.int32),
    picked: wp.array2d(dtype=wp.int32),
    num_proximal: wp.array(dtype=wp.int32),
    bucketed: wp.array3d(dtype=wp.float32),
    position: wp.array2d(dtype=wp.int32),
    boxes: wp.array3d(dtype=wp.float32),
    bucket_distance: wp.array2d(dtype=wp.int32),
    num_picks: int,
    env: int,
): ...


_FARTHEST_POINTS = r"""
    const int n = num_proximal.data[env];
    const int k = n < num_picks ? n : num_picks;
    int* P = picked.data + (size_t)env * (picked.strides[0] / sizeof(int));
    if (n <= num_picks) {
        for (int i = lane; i < n; i += num_lanes) P[i] = i;
        return;
    }
    const size_t row = (size_t)env * (x.strides[0] / sizeof(float));
    const float* __restrict__ X = x.data + row;
    const float* __restrict__ Y = y.data + row;
    const float* __restrict__ Z = z.data + row;
    int* __restrict__ D = distance.data + (size_t)env * (distance.strides[0] / sizeof(int));
    for (int i = lane; i < n; i += num_lanes) D[i] = 0x7f7fffff;
    int current = 0;
#if defined(__CUDA_ARCH__)
    // One block per environment; three slots so that a slot is cleared two barriers before its next use.
    __shared__ unsigned long long best[3];
    __syncthreads();
    if (lane < 3) best[lane] = 0ull;
    __syncthreads();
    for (int s = 0; s < k; ++s) {
        if (lane == 0) { P[s] = current; best[(s + 1) % 3] = 0ull; }
        if (lane == current % num_lanes) D[current] = -1;
        const float cx = X[current], cy = Y[current], cz = Z[current];
        unsigned long long mine = 0ull;
        for (int i = lane; i < n; i += num_lanes) {
            const float dx = X[i] - cx, dy = Y[i] - cy, dz = Z[i] - cz;
            const int d = min(D[i], __float_as_int(dx * dx + dy * dy + dz * dz));
            D[i] = d;
            if (d >= 0) {
                const unsigned long long key = ((unsigned long long)d << 32) | (unsigned int)~i;
                if (key > mine) mine = key;
            }
        }
        for (int step = 16; step > 0; step >>= 1) {
            const unsigned long long other = __shfl_down_sync(0xffffffffu, mine, step);
            if (other > mine) mine = other;
        }
        if ((lane & 31) == 0) atomicMax(&best[s % 3], mine);
        __syncthreads();
        current = (int)~(unsigned int)(best[s % 3] & 0xffffffffull);
    }
#else
    // Non-negative floats order like their bits: integer minima and maxima vectorise without fast-math.
    for (int s = 0; s < k; ++s) {
        P[s] = current;
        D[current] = -1;
        const float cx = X[current], cy = Y[current], cz = Z[current];
        int farthest = -1;
        for (int i = 0; i < n; ++i) {
            const float dx = X[i] - cx, dy = Y[i] - cy, dz = Z[i] - cz;
            const float squared = dx * dx + dy * dy + dz * dz;
            int bits;
            memcpy(&bits, &squared, sizeof(bits));
            const int d = D[i] < bits ? D[i] : bits;
            D[i] = d;
            farthest = farthest > d ? farthest : d;
        }
        current = 0;
        while (current < n - 1 && D[current] != farthest) ++current;
    }
#endif
"""


@wp.func_native(_FARTHEST_POINTS)
def farthest_points(
    x: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
    z: wp.array2d(dtype=wp.float32),
    distance: wp.array2d(dtype=wp.int32),
    picked: wp.array2d(dtype=wp.int32),
    num_proximal: wp.array(dtype=wp.int32),
    num_picks: int,
    env: int,
    lane: int,
    num_lanes: int,
): ...


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


@wp.func
def radix_sort(env: int, n: int, scratch: Scratch) -> int:
    """Stable sort of the first n items of half 0 by key; returns the half that holds the result."""
    half = wp.int32(0)
    for digit in range(4):
        shift = digit * RADIX_BITS
        for b in range(RADIX_SIZE):
            scratch.histogram[env, b] = 0
        for i in range(n):
            b = (scratch.keys[half, env, i] >> shift) & (RADIX_SIZE - 1)
            scratch.histogram[env, b] = scratch.histogram[env, b] + 1
        first = wp.int32(0)
        if n > 0:
            first = (scratch.keys[half, env, 0] >> shift) & (RADIX_SIZE - 1)
        if scratch.histogram[env, first] < n:  # otherwise this digit is the same everywhere
            start = wp.int32(0)
            for b in range(RADIX_SIZE):
                count = scratch.histogram[env, b]
                scratch.histogram[env, b] = start
                start += count
            for i in range(n):
                key = scratch.keys[half, env, i]
                b = (key >> shift) & (RADIX_SIZE - 1)
                slot = scratch.histogram[env, b]
                scratch.histogram[env, b] = slot + 1
                scratch.keys[1 - half, env, slot] = key
                scratch.items[1 - half, env, slot] = scratch.items[half, env, i]
            half = 1 - half
    return half


@wp.kernel
def raw_points(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    scale: float,
    points_out: wp.array2d(dtype=wp.vec3),
):
    """Every ray's point; a miss is zero."""
    thread, ray = wp.tid()
    env = env_offset + thread
    point = wp.vec3(0.0, 0.0, 0.0)
    if is_hit(ranges[env, ray]):
        point = (ranges[env, ray] * scale) * directions[env, ray]
    points_out[env, ray] = point


@wp.kernel
def gather_proximal(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    elevation: wp.array2d(dtype=wp.float32),
    split: float,
    scale: float,
    scratch: Scratch,
):
    """Collect the hits with theta above the split, in ray order."""
    env = env_offset + wp.tid()
    n = wp.int32(0)
    for ray in range(ranges.shape[1]):
        if is_hit(ranges[env, ray]) and elevation[env, ray] > split:
            point = (ranges[env, ray] * scale) * directions[env, ray]
            scratch.x[env, n] = point[0]
            scratch.y[env, n] = point[1]
            scratch.z[env, n] = point[2]
            scratch.ray[env, n] = ray
            n += 1
    scratch.num_proximal[env] = n


@wp.kernel
def pick_farthest(env_offset: int, num_picks: int, num_lanes: int, bucket_from: int, scratch: Scratch):
    """Exact farthest point sampling from the first hit in ray order; no point is picked twice.

    A single lane sorts ``bucket_from`` points and more into buckets, of which far ones need not be looked at.
    """
    thread, lane = wp.tid()
    num_points = scratch.num_proximal[env_offset + thread]
    if num_lanes == 1 and num_points >= bucket_from and num_points > num_picks:
        farthest_points_by_bucket(
            scratch.x,
            scratch.y,
            scratch.z,
            scratch.distance,
            scratch.picked,
            scratch.num_proximal,
            scratch.bucketed,
            scratch.position,
            scratch.boxes,
            scratch.bucket_distance,
            num_picks,
            env_offset + thread,
        )
        return
    farthest_points(
        scratch.x,
        scratch.y,
        scratch.z,
        scratch.distance,
        scratch.picked,
        scratch.num_proximal,
        num_picks,
        env_offset + thread,
        lane,
        num_lanes,
    )


@wp.kernel
def write_proximal(
    env_offset: int,
    elevation: wp.array2d(dtype=wp.float32),
    azimuth: wp.array2d(dtype=wp.float32),
    ring: float,
    num_picks: int,
    scratch: Scratch,
    points_out: wp.array2d(dtype=wp.vec3),
):
    """Write the picked points sorted by (theta ring, phi), then zeros."""
    env = env_offset + wp.tid()
    n = wp.min(scratch.num_proximal[env], num_picks)
    for i in range(n):
        ray = scratch.ray[env, scratch.picked[env, i]]
        scratch.keys[0, env, i] = sort_key(elevation[env, ray], azimuth[env, ray], ring)
        scratch.items[0, env, i] = scratch.picked[env, i]
    half = radix_sort(env, n, scratch)
    for i in range(n):
        p = scratch.items[half, env, i]
        points_out[env, i] = wp.vec3(scratch.x[env, p], scratch.y[env, p], scratch.z[env, p])
    for i in range(n, num_picks):
        points_out[env, i] = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def mean_hit(
    env: int,
    half: int,
    first: int,
    last: int,
    scale: float,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    scratch: Scratch,
) -> wp.vec3:
    """Mean of the sorted hits first..last-1."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for i in range(first, last):
        ray = scratch.items[half, env, i]
        total += (ranges[env, ray] * scale) * directions[env, ray]
    return total / float(last - first)


@wp.kernel
def write_distal(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    elevation: wp.array2d(dtype=wp.float32),
    azimuth: wp.array2d(dtype=wp.float32),
    split: float,
    ring: float,
    scale: float,
    first_slot: int,
    num_bins: int,
    scratch: Scratch,
    points_out: wp.array2d(dtype=wp.vec3),
):
    """One point per bin of consecutive distal points in (theta ring, phi) order, then zeros."""
    env = env_offset + wp.tid()
    n = wp.int32(0)
    for ray in range(ranges.shape[1]):
        if elevation[env, ray] <= split and is_hit(ranges[env, ray]):
            scratch.keys[0, env, n] = sort_key(elevation[env, ray], azimuth[env, ray], ring)
            scratch.items[0, env, n] = ray
            n += 1
    half = radix_sort(env, n, scratch)
    bins = wp.min(n, num_bins)
    for b in range(bins):
        first = b * n // bins
        last = (b + 1) * n // bins
        points_out[env, first_slot + b] = mean_hit(env, half, first, last, scale, ranges, directions, scratch)
    for b in range(bins, num_bins):
        points_out[env, first_slot + b] = wp.vec3(0.0, 0.0, 0.0)


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
    turned = (wp.atan2(p[1], p[0]) + _PI) / (2.0 * _PI)
    return band * num_sectors + wp.clamp(int(turned * float(num_sectors)), 0, num_sectors - 1)


@wp.func
def proximity_point(p: wp.vec3, proximity: float) -> wp.vec3:
    """Bearing of a point times its proximity, and that itself."""
    bearing = proximity / wp.max(wp.sqrt(p[0] * p[0] + p[1] * p[1]), 1.0e-6)
    return wp.vec3(bearing * p[0], bearing * p[1], proximity)


@wp.kernel(module="unique", enable_backward=False)
def proximity_grid(
    env_offset: int,
    ranges: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3),
    elevation: wp.array2d(dtype=wp.float32),
    split: float,
    blind: float,
    base_quat: wp.array(dtype=wp.vec4),  # (w, x, y, z)
    mount_pos: wp.vec3,
    mount_quat: wp.vec4,
    body: wp.vec2,
    band_edges: wp.array(dtype=wp.float32),
    num_sectors: int,
    decay: float,
    first_slot: int,
    points_out: wp.array2d(dtype=wp.vec3),
):
    """The nearest distal hit of each azimuth sector and height band around the base, as bearing and proximity."""
    env = env_offset + wp.tid()
    num_bands = band_edges.shape[0] - 1
    for cell in range(num_bands * num_sectors):
        points_out[env, first_slot + cell] = wp.vec3(0.0, 0.0, 0.0)
    level = levelled(base_quat[env])
    offset = wp.quat_rotate(level, mount_pos)
    turn = wp.quat_to_matrix(level * to_quat(mount_quat))
    for ray in range(ranges.shape[1]):
        distance = ranges[env, ray]
        if elevation[env, ray] <= split and is_hit(distance) and distance >= blind:
            p = offset + distance * (turn * directions[env, ray])
            cell = proximity_cell(p, body, band_edges, num_sectors)
            if cell >= 0:
                proximity = wp.exp(-wp.sqrt(p[0] * p[0] + p[1] * p[1]) / decay)
                if proximity > points_out[env, first_slot + cell][2]:
                    points_out[env, first_slot + cell] = proximity_point(p, proximity)
