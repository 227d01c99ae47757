"""The nearest hit of a sensor's ray among the shapes placed in its frame.

Warp passes structures by value. Functions that take them are called from one place, where the compiler inlines them;
a call would copy kilobytes for each ray.
"""

# ruff: noqa: SIM102, SIM108, UP018  (in a kernel, a branch on wp.static stands alone, and bool(False) declares a variable)

from functools import cache
from pathlib import Path

import warp as wp

from ..native import function_body
from .geometry import HEIGHTFIELD, INF, SLACK, Geometry, shape_functions, uncertain
from .march_block import NOT_MARCHED
from .motion import Moment, Track, shape_at
from .rotations import axes_of, flush_denormals
from .slots import SLOTS_AHEAD, WORD, Slots

wp.set_module_options({"enable_backward": False})


FEW = wp.constant(2)
"""Slots that are tried without asking which are ahead."""


@wp.struct
class Located:
    """Pose of a shape for a ray that starts at the origin: its centre, and its axes in rows."""

    c: wp.vec3
    axes: wp.mat33


@wp.struct
class SlotHit:
    """The hit on a slot's shape: distance, face of a mesh, and whether float32 leaves the distance uncertain."""

    t: wp.float32
    face: wp.int32
    is_uncertain: wp.bool


@wp.struct
class NearestHit:
    """First hit of a ray: its distance, the slot, -1 for nothing, and the face of a mesh."""

    t: wp.float32
    slot: wp.int32
    face: wp.int32


@wp.func_native(function_body(SLOTS_AHEAD))
def slots_ahead(
    words: wp.array3d(dtype=wp.float32), env: int, word: int, count: int, dx: float, dy: float, dz: float
) -> int:
    """Those of the first ``count`` of a word's slots that a ray along (dx, dy, dz) may hit, one bit each."""
    ...


@wp.func
def first_slots(count: int):
    """The first ``count`` of a word's slots."""
    if count >= WORD:
        return -1
    return (1 << count) - 1


@wp.func_native(function_body(Path(__file__).with_name("lowest_bit.h")))
def lowest_bit(bits: int) -> int:
    """Index of the lowest bit that is set; one must be."""
    ...


@wp.func
def passes_sphere(d: wp.vec3, c: wp.vec3, radius: float):
    """Tell whether a ray from the origin misses a sphere around c, with room for rounding."""
    along = wp.dot(d, c)
    square = wp.dot(c, c)
    outside = square - radius * radius * (1.0 + SLACK)
    return outside > SLACK * square and along * wp.abs(along) < outside - SLACK * square


@cache
def search_functions(has: frozenset[str]) -> tuple[wp.Function, wp.Function]:
    """Functions (search, locate) for the arguments of ``scan_kernel``."""
    moving, displaced, marched = "motion" in has, "origins" in has, "marched" in has
    intersect, refine, _ = shape_functions("mesh" in has, "heightfield" in has)

    @wp.func
    def pose_of(slots: Slots, track: Track, moment: Moment, env: int, slot: int):
        """Pose of a slot's shape relative to where the ray starts, in the sensor's frame."""
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
        """The same in float32."""
        located = Located()
        if wp.static(moving):
            pose = pose_of(slots, track, moment, env, slot)
            located.c = flush_denormals(wp.vec3(wp.transform_get_translation(pose)))
            located.axes = axes_of(pose)
        else:
            bound = slots.bound[env, slot]
            located.c = wp.vec3(bound[0], bound[1], bound[2])
            located.axes = slots.axes[env, slot]
            if wp.static(displaced):
                located.c = located.c - moment.origin
        return located

    @wp.func
    def nearest(near: float, reach: float):
        """A lower bound of a slot's distance from where the ray starts."""
        if wp.static(displaced):
            return near - reach
        else:
            return near

    @wp.func
    def hit_slot(
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
        """The hit on a slot's shape; that of a height field by rays >= 0 may have been noted."""
        shape = slots.shape[env, slot]
        if wp.static(marched):
            if ray >= 0 and geometry.kind[shape] == HEIGHTFIELD:
                face = slots.marched_face[env, ray]
                if face != NOT_MARCHED:
                    return SlotHit(slots.marched_t[env, ray], face, slots.marched_uncertain[env, ray])
        at = locate(slots, track, moment, env, slot)
        if wp.static(displaced):
            if passes_sphere(d, at.c, geometry.radius[env, shape]):
                return SlotHit(INF, -1, False)
        hit = intersect(geometry, shape, env, d, at.c, at.axes, limit)
        return SlotHit(hit.t, hit.face, uncertain(hit, at.c))

    @wp.func
    def search(
        geometry: Geometry, slots: Slots, track: Track, moment: Moment, env: int, ray: int, d: wp.vec3, limit: float
    ):
        """The nearest hit closer than ``limit`` along unit d.

        Slots are sorted by a lower bound of their distance. Those of a word that are ahead are tried one after the
        other until the next one cannot be nearer than the best hit. What float32 leaves uncertain about its distance is
        computed again in float64.
        """
        best = limit
        best_slot = wp.int32(-1)
        face = wp.int32(-1)
        is_uncertain = bool(False)
        word = wp.int32(0)
        left = slots.count[env]
        while left > 0:
            if nearest(slots.near[env, word * WORD], slots.reach) >= best:
                break
            bits = wp.int32(0)
            if wp.static(displaced):
                bits = first_slots(left)
            else:
                if left > FEW:
                    bits = slots_ahead(slots.words, env, word, left, d[0], d[1], d[2])
                else:
                    bits = first_slots(left)
            while bits != 0:
                slot = word * WORD + lowest_bit(bits)
                bits = bits & (bits - 1)
                if nearest(slots.near[env, slot], slots.reach) >= best:
                    bits = wp.int32(0)
                    left = wp.int32(0)
                else:
                    hit = hit_slot(geometry, slots, track, moment, env, ray, slot, d, best)
                    if hit.t < best:
                        best = hit.t
                        best_slot = slot
                        face = hit.face
                        is_uncertain = hit.is_uncertain
            word += 1
            left -= WORD
        if is_uncertain:
            pose = pose_of(slots, track, moment, env, best_slot)
            best = refine(geometry, slots.shape[env, best_slot], env, face, wp.vec3d(d), pose, best)
        return NearestHit(best, best_slot, face)

    return search, locate
