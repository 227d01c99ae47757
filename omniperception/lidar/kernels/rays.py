"""General rays, for cameras and checks."""

from functools import cache

import warp as wp

from .geometry import INF, SLACK, Geometry, shape_functions


@cache
def rays_kernel(kinds: frozenset[int]) -> wp.Kernel:
    """The kernel for scenes of these kinds of shapes."""
    functions = shape_functions(kinds)
    meet, normal_of = functions.meet, functions.normal

    @wp.kernel(module="unique", enable_backward=False)
    def cast_rays(
        env_offset: int,
        # rays
        origins: wp.array2d(dtype=wp.vec3),
        directions: wp.array2d(dtype=wp.vec3),
        max_range: float,
        with_normals: int,
        # scene
        geometry: Geometry,
        slot_bound: wp.array2d(dtype=wp.vec4),
        slot_shape: wp.array2d(dtype=wp.int32),
        slot_axes: wp.array2d(dtype=wp.mat33),
        num_slots: wp.array(dtype=wp.int32),
        # out
        ranges_out: wp.array2d(dtype=wp.float32),
        shape_id_out: wp.array2d(dtype=wp.int32),
        normals_out: wp.array2d(dtype=wp.vec3),
    ):
        """Casts one ray with an origin of its own, in the environment's frame."""
        i, ray = wp.tid()
        env = i + env_offset
        origin = origins[env, ray]
        d = wp.normalize(directions[env, ray])
        best = max_range
        hit = wp.int32(-1)
        hit_slot = wp.int32(0)
        hit_face = wp.int32(-1)
        for s in range(num_slots[env]):
            shape = slot_shape[env, s]
            bound = slot_bound[env, s]
            c = wp.vec3(bound[0], bound[1], bound[2]) - origin
            radius = geometry.radius[shape]
            ahead = wp.dot(d, c)
            away = wp.dot(c, c) - radius * radius * (1.0 + SLACK)
            if away <= SLACK * wp.dot(c, c) or ahead * wp.abs(ahead) >= away - SLACK * wp.dot(c, c):
                met = meet(geometry, shape, env, d, c, slot_axes[env, s], best)
                if met.t < best:
                    best = met.t
                    hit = shape
                    hit_face = met.face
                    hit_slot = s
        if with_normals != 0:
            normal = wp.vec3(0.0, 0.0, 0.0)
            if hit >= 0:
                bound = slot_bound[env, hit_slot]
                axes = slot_axes[env, hit_slot]
                point = axes * (origin + best * d - wp.vec3(bound[0], bound[1], bound[2]))
                normal = wp.transpose(axes) * normal_of(geometry, hit, env, hit_face, point)
            normals_out[env, ray] = normal
        if hit < 0:
            best = INF
        ranges_out[env, ray] = best
        shape_id_out[env, ray] = hit

    return cast_rays
