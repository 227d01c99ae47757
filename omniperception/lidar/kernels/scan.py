"""One frame of a LiDAR."""

from functools import cache

import warp as wp

from .geometry import INF, Geometry, shape_functions

ScanRow = wp.types.vector(length=5, dtype=wp.float32)


@cache
def scan_kernel(kinds: frozenset[int]) -> wp.Kernel:
    """The kernel for scenes of these kinds of shapes."""
    meet = shape_functions(kinds).meet

    @wp.kernel(module="unique", enable_backward=False)
    def cast_scan(
        env_offset: int,
        # scan
        scan: wp.array(dtype=ScanRow),
        first_row: wp.array(dtype=wp.int64),
        stride: int,
        min_range: float,
        max_range: float,
        # scene
        geometry: Geometry,
        slot_bound: wp.array2d(dtype=wp.vec4),
        slot_near: wp.array2d(dtype=wp.float32),
        slot_shape: wp.array2d(dtype=wp.int32),
        slot_axes: wp.array2d(dtype=wp.mat33),
        num_slots: wp.array(dtype=wp.int32),
        # out
        ranges_out: wp.array2d(dtype=wp.float32),
        shape_id_out: wp.array2d(dtype=wp.int32),
        class_id_out: wp.array2d(dtype=wp.int32),
        directions_out: wp.array2d(dtype=wp.vec3),
        elevation_out: wp.array2d(dtype=wp.float32),
        azimuth_out: wp.array2d(dtype=wp.float32),
        row_out: wp.array2d(dtype=wp.int32),
    ):
        """Casts one ray of the scan from the sensor's origin, in the sensor's frame."""
        i, ray = wp.tid()
        env = i + env_offset
        row = int(first_row[env]) + ray * stride
        if row >= scan.shape[0]:
            row = row % scan.shape[0]
        entry = scan[row]
        d = wp.vec3(entry[0], entry[1], entry[2])
        best = max_range
        hit = wp.int32(-1)
        for s in range(num_slots[env]):
            if slot_near[env, s] >= best:
                break
            bound = slot_bound[env, s]
            ahead = d[0] * bound[0] + d[1] * bound[1] + d[2] * bound[2]
            if ahead * wp.abs(ahead) >= bound[3]:
                shape = slot_shape[env, s]
                c = wp.vec3(bound[0], bound[1], bound[2])
                t = meet(geometry, shape, env, d, c, slot_axes[env, s], best).t
                if t < best:
                    best = t
                    hit = shape
        if hit < 0 or best < min_range:
            best = INF
            hit = wp.int32(-1)
        label = wp.int32(-1)
        if hit >= 0:
            label = geometry.class_id[hit]
        ranges_out[env, ray] = best
        shape_id_out[env, ray] = hit
        class_id_out[env, ray] = label
        directions_out[env, ray] = d
        elevation_out[env, ray] = entry[3]
        azimuth_out[env, ray] = entry[4]
        row_out[env, ray] = row

    return cast_scan
