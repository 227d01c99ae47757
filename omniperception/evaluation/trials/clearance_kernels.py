"""Warp kernel of the clearance: distances between convex shapes, one thread for each environment."""

import warp as wp

CAPSULE, CYLINDER, BOX, HULL = range(4)
"""Kinds of shapes about the local z axis; a sphere is a capsule of length 0."""
TOLERANCE = 5e-4
"""Distances are worked out to within this (m)."""

_CAPSULE, _CYLINDER, _BOX, _HULL = (wp.constant(kind) for kind in range(4))
_TOLERANCE = wp.constant(TOLERANCE)
_CHECKS = wp.constant(40)
_BETWEEN_CHECKS = wp.constant(5)


@wp.func
def shortened(vec: wp.vec3, most: float) -> wp.vec3:
    return vec * wp.min(most / wp.max(wp.length(vec), 1.0e-12), 1.0)


@wp.func
def nearest_in_triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3) -> wp.vec3:
    """The point of a triangle that is nearest to another, by the region of its plane that holds it."""
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return a
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return a + d1 / (d1 - d3) * ab
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return a + d2 / (d2 - d6) * ac
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)
    whole = va + vb + vc
    return a + vb / whole * ab + vc / whole * ac


@wp.func
def nearest_in_bounds(kind: int, size: wp.vec3, p: wp.vec3) -> wp.vec3:
    """The point of a shape that is nearest to another, itself where it lies inside; a hull is its bounding box."""
    if kind == _CAPSULE:
        axis = wp.vec3(0.0, 0.0, wp.clamp(p[2], -size[1], size[1]))
        return axis + shortened(p - axis, size[0])
    if kind == _CYLINDER:
        disc = shortened(wp.vec3(p[0], p[1], 0.0), size[0])
        return wp.vec3(disc[0], disc[1], wp.clamp(p[2], -size[1], size[1]))
    return wp.vec3(
        wp.clamp(p[0], -size[0], size[0]), wp.clamp(p[1], -size[1], size[1]), wp.clamp(p[2], -size[2], size[2])
    )


@wp.func
def nearest_point(
    kind: int, size: wp.vec3, corners: wp.array3d(dtype=wp.vec3), shape: int, num_faces: int, p: wp.vec3
) -> wp.vec3:
    """The point of a shape that is nearest to another (m, in its frame), itself where it lies inside."""
    if kind != _HULL:
        return nearest_in_bounds(kind, size, p)
    nearest = wp.float32(-1.0)  # as long as it is inside of all faces
    found = p
    for k in range(num_faces):
        if wp.dot(p - corners[shape, k, 0], corners[shape, k, 3]) > 0.0:
            foot = nearest_in_triangle(corners[shape, k, 0], corners[shape, k, 1], corners[shape, k, 2], p)
            distance = wp.length_sq(foot - p)
            if nearest < 0.0 or distance < nearest:
                nearest = distance
                found = foot
    return found


@wp.func
def support(
    kind: int, size: wp.vec3, corners: wp.array3d(dtype=wp.vec3), shape: int, num_faces: int, direction: wp.vec3
) -> float:
    """How far (m) a shape reaches in a unit direction."""
    if kind == _HULL:
        farthest = wp.float32(-1.0e30)
        for k in range(num_faces):
            for corner in range(3):
                farthest = wp.max(farthest, wp.dot(corners[shape, k, corner], direction))
        return farthest
    if kind == _BOX:
        return wp.dot(wp.vec3(wp.abs(direction[0]), wp.abs(direction[1]), wp.abs(direction[2])), size)
    reach = size[1] * wp.abs(direction[2])
    if kind == _CYLINDER:
        return reach + size[0] * wp.length(wp.vec2(direction[0], direction[1]))
    return reach + size[0]


@wp.func
def convex_distance(
    kind_a: int,
    size_a: wp.vec3,
    corners_a: wp.array3d(dtype=wp.vec3),
    a: int,
    faces_a: int,
    kind_b: int,
    size_b: wp.vec3,
    corners_b: wp.array3d(dtype=wp.vec3),
    b: int,
    faces_b: int,
    pos: wp.vec3,
    mat: wp.mat33,
    below: float,
) -> float:
    """Distance (m) of shape B at a pose in the frame of A, at most TOLERANCE too large where it is less than `below`.

    Half the squared distance of a point x of A from B has the gradient x - P_B(x), so that projected gradient descent
    alternates the projections onto the two shapes; it is accelerated after Nesterov and restarted where the momentum
    points away from the descent. It is done when the plane through P_B(x) square to the way from x proves that B is
    not nearer: no point of B lies before it, and none of A farther than A's support; or that it is not below `below`.
    """
    point = nearest_point(kind_a, size_a, corners_a, a, faces_a, pos)
    ahead = point
    momentum = wp.float32(1.0)
    distance = wp.float32(0.0)
    for _check in range(_CHECKS):
        for _step in range(_BETWEEN_CHECKS):
            local = wp.transpose(mat) * (ahead - pos)
            foot = mat * nearest_point(kind_b, size_b, corners_b, b, faces_b, local) + pos
            new = nearest_point(kind_a, size_a, corners_a, a, faces_a, foot)
            step = new - point
            if wp.dot(ahead - new, step) > 0.0:
                momentum = 1.0
            grown = (1.0 + wp.sqrt(1.0 + 4.0 * momentum * momentum)) / 2.0
            ahead = new + (momentum - 1.0) / grown * step
            point = new
            momentum = grown
        local = wp.transpose(mat) * (point - pos)
        foot = mat * nearest_point(kind_b, size_b, corners_b, b, faces_b, local) + pos
        distance = wp.length(foot - point)
        if distance <= _TOLERANCE:
            return distance
        normal = (foot - point) / distance
        proven = wp.dot(normal, foot) - support(kind_a, size_a, corners_a, a, faces_a, normal)
        if distance - proven <= _TOLERANCE or proven >= below:
            return distance
    return distance


@wp.kernel(module="unique", enable_backward=False)
def clearances(
    env_offset: int,
    kind_r: wp.array(dtype=wp.int32),
    size_r: wp.array2d(dtype=wp.vec3),
    radius_r: wp.array(dtype=wp.float32),
    corners_r: wp.array3d(dtype=wp.vec3),
    faces_r: wp.array(dtype=wp.int32),
    pos_r: wp.array2d(dtype=wp.vec3),
    mat_r: wp.array2d(dtype=wp.mat33),
    kind_o: wp.array(dtype=wp.int32),
    size_o: wp.array2d(dtype=wp.vec3),
    corners_o: wp.array3d(dtype=wp.vec3),
    faces_o: wp.array(dtype=wp.int32),
    pos_o: wp.array2d(dtype=wp.vec3),
    mat_o: wp.array2d(dtype=wp.mat33),
    least: wp.array(dtype=wp.float32),
):
    """Lowers `least` (num_envs,) to the distance between the nearest of R and of O shapes where that is less.

    The centre of a robot's shape bounds the distance from above, the sphere around it from below; only pairs in doubt
    are worked out.
    """
    e = env_offset + wp.tid()
    nearest = least[e]
    for o in range(kind_o.shape[0]):
        for r in range(kind_r.shape[0]):
            local = wp.transpose(mat_o[e, o]) * (pos_r[e, r] - pos_o[e, o])
            centre = wp.length(local)  # of a hull, which holds its own
            if kind_o[o] != _HULL:
                centre = wp.length(local - nearest_in_bounds(kind_o[o], size_o[e, o], local))
            if centre < nearest:  # what is not a number is not
                nearest = centre
    for o in range(kind_o.shape[0]):
        for r in range(kind_r.shape[0]):
            local = wp.transpose(mat_o[e, o]) * (pos_r[e, r] - pos_o[e, o])
            apart = wp.length(local - nearest_in_bounds(kind_o[o], size_o[e, o], local))
            if apart - radius_r[r] < nearest:
                into = wp.transpose(mat_r[e, r])
                distance = convex_distance(
                    kind_r[r],
                    size_r[e, r],
                    corners_r,
                    r,
                    faces_r[r],
                    kind_o[o],
                    size_o[e, o],
                    corners_o,
                    o,
                    faces_o[o],
                    into * (pos_o[e, o] - pos_r[e, r]),
                    into * mat_o[e, o],
                    nearest,
                )
                if distance < nearest:
                    nearest = distance
                if distance < least[e]:
                    least[e] = distance
