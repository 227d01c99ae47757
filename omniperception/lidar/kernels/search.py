"""The nearest hit of a sensor's ray among the shapes placed in its frame."""

# ruff: noqa: SIM102, UP018  (in a kernel, a branch on wp.static stands alone, and wp.int32(0) declares a variable)

from collections.abc import Iterable
from functools import lru_cache

import warp as wp

from .field_block import UNKNOWN
from .geometry import HEIGHTFIELD, INF, SLACK, Geometry, Hit, shape_functions, uncertain
from .motion import Moment, Track, shape_at
from .place import settled
from .variants import MAX_VARIANTS

wp.set_module_options({"enable_backward": False})

WORD = 32
"""Slots whose bounds are compared at once."""

FEW_SLOTS = 16
"""Up to so many slots are compared one by one: packing them takes longer than it saves."""


@wp.struct
class Slots:
    """Shapes in the sensor's frame, nearest first; S slots, W words of WORD slots."""

    bound: wp.array2d(dtype=wp.vec4)  # (num_envs, S) centre and rejection threshold
    near: wp.array2d(dtype=wp.float32)  # (num_envs, S) lower bound of the distance
    shape: wp.array2d(dtype=wp.int32)  # (num_envs, S)
    axes: wp.array2d(dtype=wp.mat33)  # (num_envs, S) the shape's axes in rows
    pose: wp.array2d(dtype=wp.transformd)  # (num_envs, S) its pose in float64
    count: wp.array(dtype=wp.int32)  # (num_envs,) slots in use
    words: wp.array3d(dtype=wp.float32)  # (num_envs, W, 4 * WORD) x, y, z and threshold of each word's slots
    walked_t: wp.array2d(dtype=wp.float32)  # (num_envs, N) what each ray meets of the height field
    walked_slope: wp.array2d(dtype=wp.float32)
    walked_face: wp.array2d(dtype=wp.int32)
    reach: wp.float32  # how far from the sensor's origin rays start, metres


@wp.struct
class Met:
    """What a ray met first: its distance, the slot, -1 for nothing, and the face of a mesh."""

    t: wp.float32
    slot: wp.int32
    face: wp.int32


@wp.func
def is_ahead(d: wp.vec3, bound: wp.vec4):
    """Whether a ray along d may meet what lies within ``bound``."""
    ahead = d[0] * bound[0] + d[1] * bound[1] + d[2] * bound[2]
    return ahead * wp.abs(ahead) >= bound[3]


_SLOTS_AHEAD = """
    constexpr int n = WORD;
    const float* __restrict__ x = words.data + (size_t)env * (words.strides[0] / sizeof(float)) + word * (4 * n);
    int bits = 0;
    for (int k = 0; k < n; ++k) {
        const float ahead = dx * x[k] + dy * x[n + k] + dz * x[2 * n + k];
        bits |= (ahead * fabsf(ahead) >= x[3 * n + k]) ? (int)(1u << k) : 0;
    }
    return bits;
""".replace("WORD", str(WORD))


@wp.func_native(_SLOTS_AHEAD)
def slots_ahead(words: wp.array3d(dtype=wp.float32), env: int, word: int, dx: float, dy: float, dz: float) -> int:
    """``is_ahead`` of a word's slots, one bit each; the CPU's compiler turns the loop into vector instructions."""
    ...


_LOWEST_BIT = """
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz((unsigned int)bits);
#endif
"""


@wp.func_native(_LOWEST_BIT)
def lowest_bit(bits: int) -> int:
    """Index of the lowest bit that is set; one must be."""
    ...


@wp.kernel(module="unique", enable_backward=False)
def pack_slots(env_offset: int, slots: Slots):
    """Copies one environment's bounds into words; slots that are not in use are never ahead."""
    env = wp.tid() + env_offset
    count = slots.count[env]
    for slot in range((count + WORD - 1) // WORD * WORD):
        word = slot // WORD
        k = slot - word * WORD
        if slot < count:
            bound = slots.bound[env, slot]
            slots.words[env, word, k] = bound[0]
            slots.words[env, word, WORD + k] = bound[1]
            slots.words[env, word, 2 * WORD + k] = bound[2]
            slots.words[env, word, 3 * WORD + k] = bound[3]
        else:
            slots.words[env, word, 3 * WORD + k] = INF


@wp.struct
class Located:
    """Where a shape is for a ray that starts at the origin: its centre, and its axes in rows."""

    c: wp.vec3
    axes: wp.mat33


@lru_cache(MAX_VARIANTS)
def locate_functions(moving: bool, displaced: bool) -> tuple[wp.Function, wp.Function]:
    """(slots, track, moment, env, slot) -> Located, and the same as a pose in float64.

    Args:
        moving: Whether things move within the frame; they are then where they are at the ray's own moment.
        displaced: Whether rays start beside the sensor's origin.
    """

    @wp.func
    def pose_of(slots: Slots, track: Track, moment: Moment, env: int, slot: int):
        pose = wp.transformd()
        if wp.static(moving):
            pose = moment.to_view * shape_at(track, env, slots.shape[env, slot], moment.segment, moment.fraction)
        else:
            pose = slots.pose[env, slot]
        if wp.static(displaced):
            p = wp.transform_get_translation(pose) - wp.vec3d(moment.origin)
            pose = wp.transformation(p, wp.transform_get_rotation(pose))
        return pose

    @wp.func
    def locate(slots: Slots, track: Track, moment: Moment, env: int, slot: int):
        located = Located()
        if wp.static(moving):
            pose = pose_of(slots, track, moment, env, slot)
            turn = wp.mat33(wp.quat_to_matrix(wp.transform_get_rotation(pose)))
            located.c = settled(wp.vec3(wp.transform_get_translation(pose)))
            located.axes = wp.matrix_from_rows(
                settled(wp.vec3(turn[0, 0], turn[1, 0], turn[2, 0])),
                settled(wp.vec3(turn[0, 1], turn[1, 1], turn[2, 1])),
                settled(wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])),
            )
        else:
            bound = slots.bound[env, slot]
            located.c = wp.vec3(bound[0], bound[1], bound[2])
            located.axes = slots.axes[env, slot]
            if wp.static(displaced):
                located.c = located.c - moment.origin
        return located

    return locate, pose_of


@lru_cache(MAX_VARIANTS)
def search_function(kinds: Iterable[int], packed: bool, moving: bool, displaced: bool, walked: bool) -> wp.Function:
    """(geometry, slots, track, moment, env, ray, d, limit) -> Met: the nearest hit closer than ``limit`` along unit d.

    What float32 leaves uncertain about its distance is computed again in float64. With ``walked``, what rays >= 0 meet
    of the height field has been noted in ``slots`` beforehand.
    """
    functions = shape_functions(kinds)
    meet, refine = functions.meet, functions.refine
    locate, pose_of = locate_functions(moving, displaced)

    @wp.func
    def displaced_or_ahead(d: wp.vec3, bound: wp.vec4):
        if wp.static(displaced):
            return True
        else:
            return is_ahead(d, bound)

    @wp.func
    def hit_of(
        geometry: Geometry,
        slots: Slots,
        track: Track,
        moment: Moment,
        env: int,
        ray: int,
        slot: int,
        d: wp.vec3,
        limit: float,
    ):
        """Where the ray meets a slot's shape; the slope is negative where float32 leaves the distance uncertain."""
        shape = slots.shape[env, slot]
        at = locate(slots, track, moment, env, slot)
        if wp.static(displaced):
            along = wp.dot(d, at.c)
            square = wp.dot(at.c, at.c)
            outside = square - geometry.radius[shape] * geometry.radius[shape] * (1.0 + SLACK)
            if outside > SLACK * square and along * wp.abs(along) < outside - SLACK * square:
                return Hit(INF, -1, 0.0)
        hit = Hit(INF, UNKNOWN, 0.0)
        if wp.static(walked):
            if ray >= 0 and geometry.kind[shape] == HEIGHTFIELD:
                hit = Hit(slots.walked_t[env, ray], slots.walked_face[env, ray], slots.walked_slope[env, ray])
        if hit.face == UNKNOWN:
            hit = meet(geometry, shape, env, d, at.c, at.axes, limit)
            if uncertain(hit, at.c):
                hit.slope = -1.0
        return hit

    @wp.func
    def refined(geometry: Geometry, slots: Slots, track: Track, moment: Moment, env: int, d: wp.vec3, met: Met):
        """The distance of a hit in float64."""
        pose = pose_of(slots, track, moment, env, met.slot)
        return refine(geometry, slots.shape[env, met.slot], env, met.face, wp.vec3d(d), pose, met.t)

    @wp.func
    def search(
        geometry: Geometry, slots: Slots, track: Track, moment: Moment, env: int, ray: int, d: wp.vec3, limit: float
    ):
        best = limit
        slot = wp.int32(-1)
        face = wp.int32(-1)
        slope = float(0.0)
        for s in range(slots.count[env]):
            if slots.near[env, s] - slots.reach >= best:
                break
            if displaced_or_ahead(d, slots.bound[env, s]):
                hit = hit_of(geometry, slots, track, moment, env, ray, s, d, best)
                if hit.t < best:
                    best = hit.t
                    slot = s
                    face = hit.face
                    slope = hit.slope
        if slope < 0.0:
            best = refined(geometry, slots, track, moment, env, d, Met(best, slot, face))
        return Met(best, slot, face)

    @wp.func
    def search_packed(
        geometry: Geometry, slots: Slots, track: Track, moment: Moment, env: int, ray: int, d: wp.vec3, limit: float
    ):
        best = limit
        slot = wp.int32(-1)
        face = wp.int32(-1)
        slope = float(0.0)
        word = wp.int32(0)
        left = slots.count[env]
        while left > 0:
            if slots.near[env, word * WORD] >= best:
                break
            bits = slots_ahead(slots.words, env, word, d[0], d[1], d[2])
            while bits != 0:
                s = word * WORD + lowest_bit(bits)
                bits = bits & (bits - 1)
                if slots.near[env, s] >= best:
                    bits = wp.int32(0)
                    left = wp.int32(0)
                else:
                    hit = hit_of(geometry, slots, track, moment, env, ray, s, d, best)
                    if hit.t < best:
                        best = hit.t
                        slot = s
                        face = hit.face
                        slope = hit.slope
            word += 1
            left -= WORD
        if slope < 0.0:
            best = refined(geometry, slots, track, moment, env, d, Met(best, slot, face))
        return Met(best, slot, face)

    return search_packed if packed else search
