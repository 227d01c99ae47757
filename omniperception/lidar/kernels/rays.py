"""General rays, for cameras and checks."""

# ruff: noqa: UP018  (in a kernel, bool(False) declares a variable that may change)

import warp as wp

from .geometry import INF, SLACK, Geometry, shape_functions, uncertain
from .place import GROUP
from .variants import variants


@variants
def rays_kernel(kinds: frozenset[int], ray_type: type) -> wp.Kernel:
    """The kernel for scenes of these kinds of shapes and rays in ``wp.float32`` or ``wp.float64``."""
    functions = shape_functions(kinds)
    meet, normal_of, refine = functions.meet, functions.normal, functions.refine
    vec3 = wp.types.vector(3, ray_type)

    @wp.func
    def may_meet(d: wp.vec3, c: wp.vec3, radius: float, best: float):
        """Whether a ray from the origin comes into a sphere before ``best``, with room for rounding."""
        ahead = wp.dot(d, c)
        square = wp.dot(c, c)
        outside = square - radius * radius * (1.0 + SLACK)
        return ahead - radius * (1.0 + SLACK) < best and (
            outside <= SLACK * square or ahead * wp.abs(ahead) >= outside - SLACK * square
        )

    @wp.kernel(module="unique", enable_backward=False)
    def cast_rays(
        env_offset: int,
        # rays
        origins: wp.array2d(dtype=vec3),
        directions: wp.array2d(dtype=vec3),
        max_range: float,
        with_normals: int,
        # scene
        geometry: Geometry,
        group_bound: wp.array2d(dtype=wp.vec4d),
        slot_shape: wp.array2d(dtype=wp.int32),
        slot_axes: wp.array2d(dtype=wp.mat33),
        slot_pose: wp.array2d(dtype=wp.transformd),
        num_slots: wp.array(dtype=wp.int32),
        # out
        ranges_out: wp.array2d(dtype=wp.float32),
        shape_id_out: wp.array2d(dtype=wp.int32),
        normals_out: wp.array2d(dtype=wp.vec3),
    ):
        """Casts one ray with an origin of its own, in the environment's frame.

        The way to the sphere around a shape is gone in float64, so that float32 resolves small shapes far away.
        """
        i, ray = wp.tid()
        env = i + env_offset
        origin = wp.vec3d(origins[env, ray])
        direction = wp.vec3d(directions[env, ray])
        length = wp.length(direction)
        count = num_slots[env]
        if not (length > wp.float64(0.0) and wp.isfinite(length + wp.length(origin))):
            count = wp.int32(0)
        direction = direction / length
        d = wp.vec3(direction)
        best = max_range
        doubtful = bool(False)
        hit = wp.int32(-1)
        hit_slot = wp.int32(0)
        hit_face = wp.int32(-1)
        for group in range((count + GROUP - 1) // GROUP):
            bound = group_bound[env, group]
            middle = wp.vec3(wp.vec3d(bound[0], bound[1], bound[2]) - origin)
            if may_meet(d, middle, float(bound[3]), best):
                for s in range(group * GROUP, wp.min(group * GROUP + GROUP, count)):
                    shape = slot_shape[env, s]
                    radius = geometry.radius[shape]
                    away = wp.transform_get_translation(slot_pose[env, s]) - origin
                    if may_meet(d, wp.vec3(away), radius, best):
                        skipped = wp.max(wp.dot(direction, away) - wp.float64(1.01 * radius), wp.float64(0.0))
                        c = wp.vec3(away - skipped * direction)
                        met = meet(geometry, shape, env, d, c, slot_axes[env, s], best - float(skipped))
                        t = float(skipped) + met.t
                        if t < best:
                            best = t
                            hit = shape
                            hit_face = met.face
                            hit_slot = s
                            doubtful = uncertain(met, c)
        normal = wp.vec3(0.0, 0.0, 0.0)
        if hit >= 0:
            pose = slot_pose[env, hit_slot]
            centre = wp.transform_get_translation(pose) - origin
            if doubtful:
                pose = wp.transformation(centre, wp.transform_get_rotation(pose))
                best = refine(geometry, hit, env, hit_face, direction, pose, best)
            if with_normals != 0:
                axes = slot_axes[env, hit_slot]
                point = axes * wp.vec3(wp.float64(best) * direction - centre)
                normal = wp.transpose(axes) * normal_of(geometry, hit, env, hit_face, point)
        if with_normals != 0:
            normals_out[env, ray] = normal
        if hit < 0:
            best = INF
        ranges_out[env, ray] = best
        shape_id_out[env, ray] = hit

    return cast_rays
