"""General rays, for cameras and checks."""

# ruff: noqa: UP018  (in a kernel, bool(False) declares a variable that may change)

from functools import cache
from typing import Any

import warp as wp

from .geometry import INF, SLACK, Geometry, shape_functions, uncertain
from .place import GROUP
from .slots import Slots


@wp.func
def may_hit(d: wp.vec3, c: wp.vec3, radius: float, best: float):
    """Tell whether a ray from the origin comes into a sphere before ``best``, with room for rounding."""
    ahead = wp.dot(d, c)
    square = wp.dot(c, c)
    outside = square - radius * radius * (1.0 + SLACK)
    return ahead - radius * (1.0 + SLACK) < best and (
        outside <= SLACK * square or ahead * wp.abs(ahead) >= outside - SLACK * square
    )


@cache
def rays_kernel(mesh: bool, heightfield: bool) -> wp.Kernel:
    """The kernel for scenes with or without meshes and height fields."""
    intersect, refine, shape_normal = shape_functions(mesh, heightfield)

    @wp.kernel(module="unique", enable_backward=False)
    def cast_rays(
        env_offset: int,
        # rays
        origins: wp.array2d(dtype=Any),
        directions: wp.array2d(dtype=Any),
        max_range: float,
        # scene
        geometry: Geometry,
        groups: wp.array2d(dtype=wp.vec4d),
        slots: Slots,
        # out
        ranges_out: wp.array2d(dtype=wp.float32),
        shape_id_out: wp.array2d(dtype=wp.int32),
        normals_out: wp.array2d(dtype=wp.vec3),
    ):
        """Casts one ray with an origin of its own, in the environment's frame.

        Groups of GROUP slots are passed by with one comparison. The way to the sphere around a shape is gone in
        float64, so that float32 resolves small shapes far away.
        """
        i, ray = wp.tid()
        env = i + env_offset
        origin = wp.vec3d(origins[env, ray])
        direction = wp.vec3d(directions[env, ray])
        length = wp.length(direction)
        count = slots.count[env]
        if not (length > wp.float64(0.0) and wp.isfinite(length + wp.length(origin))):
            count = wp.int32(0)
        direction = direction / length
        d = wp.vec3(direction)
        best = max_range
        is_uncertain = bool(False)
        hit_slot = wp.int32(-1)
        hit_face = wp.int32(-1)
        for group in range((count + GROUP - 1) // GROUP):
            bound = groups[env, group]
            middle = wp.vec3(wp.vec3d(bound[0], bound[1], bound[2]) - origin)
            if may_hit(d, middle, float(bound[3]), best):
                for s in range(group * GROUP, wp.min(group * GROUP + GROUP, count)):
                    shape = slots.shape[env, s]
                    radius = geometry.radius[env, shape]
                    away = wp.transform_get_translation(slots.pose[env, s]) - origin
                    if may_hit(d, wp.vec3(away), radius, best):
                        skipped = wp.max(wp.dot(direction, away) - wp.float64(1.01 * radius), wp.float64(0.0))
                        c = wp.vec3(away - skipped * direction)
                        hit = intersect(geometry, shape, env, d, c, slots.axes[env, s], best - float(skipped))
                        t = float(skipped) + hit.t
                        if t < best:
                            best = t
                            hit_slot = s
                            hit_face = hit.face
                            is_uncertain = uncertain(hit, c)
        hit_shape = wp.int32(-1)
        normal = wp.vec3(0.0, 0.0, 0.0)
        if hit_slot >= 0:
            hit_shape = slots.shape[env, hit_slot]
            pose = slots.pose[env, hit_slot]
            centre = wp.transform_get_translation(pose) - origin
            if is_uncertain:
                pose = wp.transformation(centre, wp.transform_get_rotation(pose))
                best = refine(geometry, hit_shape, env, hit_face, direction, pose, best)
            if normals_out:
                axes = slots.axes[env, hit_slot]
                point = axes * wp.vec3(wp.float64(best) * direction - centre)
                normal = wp.transpose(axes) * shape_normal(geometry, hit_shape, env, hit_face, point)
        if normals_out:
            normals_out[env, ray] = normal
        ranges_out[env, ray] = wp.where(hit_slot >= 0, best, INF)
        shape_id_out[env, ray] = hit_shape

    return cast_rays
