"""Rays through height fields: a march over cells under a pyramid of lowest and highest points."""

import math

import warp as wp

from .mesh import plane_through

wp.set_module_options({"enable_backward": False})

LEVEL_SHIFT = wp.constant(2)
"""A node of a level covers 2^LEVEL_SHIFT nodes of the level below along each axis; level 0 is the cells."""
WALL = wp.constant(-2)
"""The face of a hit on a side or on the base of the field; faces from 0 on are the triangles of the surface."""
INF = wp.constant(wp.float32(math.inf))
TINY = wp.constant(wp.float32(1.0e-12))


@wp.struct
class FieldPart:
    """One height field in the arrays of its scene; ``per_x`` and ``per_y`` are cells per metre.

    Lengths are in metres, heights and ``top`` in units of ``scale``.
    """

    rows: int
    cols: int
    half_x: wp.float64
    half_y: wp.float64
    base: wp.float64
    scale: wp.float64
    per_x: wp.float64
    per_y: wp.float64
    top: float
    first_height: int
    first_level: int
    top_level: int
    first_window: int
    window_cols: int


@wp.struct
class FieldHit:
    t: wp.float32
    face: wp.int32
    sin_incidence: wp.float32


@wp.func
def _inverse(x: float):
    if wp.abs(x) < TINY:
        return wp.where(x < 0.0, -1.0 / TINY, 1.0 / TINY)
    return 1.0 / x


@wp.func
def _corners(heights: wp.array(dtype=wp.float32), first: int, cols: int):
    """Heights h00, h10, h01, h11 at the corners of a cell, the first index counting along x."""
    return wp.vec4(heights[first], heights[first + 1], heights[first + cols], heights[first + cols + 1])


@wp.func
def _surface(h: wp.vec4, u: float, v: float):
    """Height at (u, v) in a cell; the diagonal of its two triangles goes from (0, 0) to (1, 1)."""
    if u >= v:
        return h[0] + u * (h[1] - h[0]) + v * (h[3] - h[1])
    return h[0] + u * (h[3] - h[2]) + v * (h[2] - h[0])


@wp.func
def _intersect_base(half: wp.vec3, o: wp.vec3, inv: wp.vec3):
    """The box under the floor, double-sided as every closed shape."""
    t_in = float(-INF)
    t_out = float(INF)
    for i in range(3):
        centre = wp.where(i == 2, -half[2], 0.0)
        a = (centre - half[i] - o[i]) * inv[i]
        b = (centre + half[i] - o[i]) * inv[i]
        t_in = wp.max(t_in, wp.min(a, b))
        t_out = wp.min(t_out, wp.max(a, b))
    if t_in > t_out or t_out < 0.0:
        return INF
    return wp.where(t_in >= 0.0, t_in, t_out)


@wp.func
def _crossing_in_cell(h: wp.vec4, z: float, z_next: float, uv: wp.vec4, t: float, t_next: float):
    """(t, triangle) where a ray first is at or below the two triangles of a cell; infinite if it is nowhere.

    It enters the cell at t, height z and uv[:2] in the cell and leaves it at t_next, z_next and uv[2:]; h holds the
    corners h00, h10, h01, h11. Over each triangle both heights are linear in t.
    """
    above = z - _surface(h, uv[0], uv[1])
    above_next = z_next - _surface(h, uv[2], uv[3])
    triangle = wp.where(uv[2] >= uv[3], 0, 1)
    across = uv[0] - uv[1]
    across_next = uv[2] - uv[3]
    if across * across_next < 0.0:  # the ray crosses the diagonal: the crossing is before or beyond that point
        f = across / (across - across_next)
        u_mid = uv[0] + f * (uv[2] - uv[0])
        above_mid = z + f * (z_next - z) - h[0] - u_mid * (h[3] - h[0])
        t_mid = t + f * (t_next - t)
        if above <= 0.0 or above_mid <= 0.0:
            t_next = t_mid
            above_next = above_mid
            triangle = wp.where(across >= 0.0, 0, 1)
        else:
            t = t_mid
            above = above_mid
    if above > 0.0 and above_next > 0.0:
        return wp.vec2(INF, 0.0)
    if above > 0.0:
        t = t + (t_next - t) * above / (above - above_next)
    return wp.vec2(t, float(triangle))


@wp.func
def intersect_heightfield(
    field: FieldPart,
    heights: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.vec2i),
    extremes: wp.array(dtype=wp.vec2),
    o: wp.vec3,
    d: wp.vec3,
    limit: float,
):
    """The nearest crossing before ``limit`` of the field's surface, of its sides or of its base.

    The march goes from node to node of the pyramid: down a level where the ray is not above the node's highest point,
    up a level where it leaves the parent. It knows on which side of the surface the ray is and looks for the first
    change, so that the borders of cells have no gaps: a crossing that rounding hides from one cell is found at the
    entry of the next. Horizontal lengths are in cells, vertical ones in units of the heights.
    """
    hit = FieldHit()
    hit.t = INF
    hit.face = -1
    end = limit

    # base
    half_x = float(field.half_x)
    half_y = float(field.half_y)
    base = float(field.base)
    if base > 0.0:
        inv = wp.vec3(_inverse(d[0]), _inverse(d[1]), _inverse(d[2]))
        t_base = _intersect_base(wp.vec3(half_x, half_y, 0.5 * base), o, inv)
        if t_base < end:
            hit.t = t_base
            hit.face = WALL
            end = t_base

    # ray in the grid, from a grid point next to the origin, where float32 is finest
    scale_x = float(field.per_x)
    scale_y = float(field.per_y)
    grid_x = (wp.float64(o[0]) + field.half_x) * field.per_x
    grid_y = (wp.float64(o[1]) + field.half_y) * field.per_y
    near_x = int(wp.clamp(grid_x, wp.float64(0.0), wp.float64(field.cols - 1)))
    near_y = int(wp.clamp(grid_y, wp.float64(0.0), wp.float64(field.rows - 1)))
    unit = 1.0 / float(field.scale)
    gx = float(grid_x - wp.float64(near_x))
    gy = float(grid_y - wp.float64(near_y))
    oz = o[2] * unit
    dx = d[0] * scale_x
    dy = d[1] * scale_y
    dz = d[2] * unit
    inv_x = _inverse(dx)
    inv_y = _inverse(dy)
    inv_z = _inverse(dz)

    # from t to end the ray is within the sides, above the floor and below the highest point
    west = (float(-near_x) - gx) * inv_x
    east = (float(field.cols - 1 - near_x) - gx) * inv_x
    south = (float(-near_y) - gy) * inv_y
    north = (float(field.rows - 1 - near_y) - gy) * inv_y
    enter = wp.max(wp.min(west, east), wp.min(south, north))
    leave = wp.min(wp.max(west, east), wp.max(south, north))
    margin = 1.0e-5 * (half_x + half_y) * unit  # a field as flat as its floor is still marched through
    bottom = (-margin - oz) * inv_z
    ceiling = (field.top + margin - oz) * inv_z
    t = wp.max(wp.max(enter, wp.min(bottom, ceiling)), 0.0)
    end = wp.min(wp.min(leave, wp.max(bottom, ceiling)), end)
    if t > end:
        return hit

    # side of the surface on which the ray begins; from below, the field is marched over upside down
    ix = wp.clamp(near_x + int(wp.floor(gx + t * dx)), 0, field.cols - 2)
    iy = wp.clamp(near_y + int(wp.floor(gy + t * dy)), 0, field.rows - 2)
    corners = _corners(heights, field.first_height + iy * field.cols + ix, field.cols)
    h = _surface(corners, gx + t * dx - float(ix - near_x), gy + t * dy - float(iy - near_y))
    side = wp.where(oz + t * dz < h, -1.0, 1.0)
    if side < 0.0 and t > 0.0 and t == enter:
        hit.t = t
        hit.face = WALL
        return hit
    oz = side * oz
    dz = side * dz

    # march
    forward_x = wp.where(inv_x > 0.0, 1, 0)
    forward_y = wp.where(inv_y > 0.0, 1, 0)
    level = wp.min(2, field.top_level)
    marching = wp.int32(1)
    while marching == 1:
        # where the ray leaves the node
        shift = level * LEVEL_SHIFT
        node_x = ix >> shift
        node_y = iy >> shift
        edge_x = (node_x + forward_x) << shift
        edge_y = (node_y + forward_y) << shift
        t_x = (float(edge_x - near_x) - gx) * inv_x
        t_y = (float(edge_y - near_y) - gy) * inv_y
        t_next = wp.max(wp.min(wp.min(t_x, t_y), end), t)
        z = oz + t * dz
        z_next = oz + t_next * dz

        # down a level, or into a cell
        if level > 0:
            row = levels[field.first_level + level]
            span = extremes[row[0] + node_y * row[1] + node_x]
            if wp.min(z, z_next) <= wp.where(side > 0.0, span[1], -span[0]):
                level -= 1
                continue
        else:
            k = field.first_height + iy * field.cols + ix
            cell = side * _corners(heights, k, field.cols)
            if wp.min(z, z_next) <= wp.max(wp.max(cell[0], cell[1]), wp.max(cell[2], cell[3])):
                x0 = float(ix - near_x)
                y0 = float(iy - near_y)
                uv = wp.vec4(gx + t * dx - x0, gy + t * dy - y0, gx + t_next * dx - x0, gy + t_next * dy - y0)
                crossing = _crossing_in_cell(cell, z, z_next, uv, t, t_next)
                if crossing[0] < INF:
                    triangle = int(crossing[1])
                    hit.t = crossing[0]
                    hit.face = 2 * (k - field.first_height) + triangle
                    rise_x = wp.where(triangle == 0, cell[1] - cell[0], cell[3] - cell[2]) * scale_x
                    rise_y = wp.where(triangle == 0, cell[3] - cell[1], cell[2] - cell[0]) * scale_y
                    square = unit * unit + rise_x * rise_x + rise_y * rise_y
                    hit.sin_incidence = wp.abs(dz - rise_x * d[0] - rise_y * d[1]) / wp.sqrt(square)
                    return hit

        # on to the next node, up a level where it has another parent
        old_x = ix
        old_y = iy
        if t_x < t_y:
            ix = edge_x - 1 + forward_x
            iy = wp.clamp(
                near_y + int(wp.floor(gy + t_next * dy)),
                node_y << shift,
                wp.min(((node_y + 1) << shift), field.rows - 1) - 1,
            )
        else:
            iy = edge_y - 1 + forward_y
            ix = wp.clamp(
                near_x + int(wp.floor(gx + t_next * dx)),
                node_x << shift,
                wp.min(((node_x + 1) << shift), field.cols - 1) - 1,
            )
        if level < field.top_level:
            above_shift = shift + LEVEL_SHIFT
            if (ix >> above_shift) != (old_x >> above_shift) or (iy >> above_shift) != (old_y >> above_shift):
                level += 1
        t = t_next
        if t >= end or ix < 0 or iy < 0 or ix > field.cols - 2 or iy > field.rows - 2:
            marching = wp.int32(0)
    if side < 0.0 and end == leave:
        hit.t = leave
        hit.face = WALL
    return hit


@wp.func
def heightfield_corner(field: FieldPart, heights: wp.array(dtype=wp.float32), row: int, col: int):
    """A point of the grid, metres."""
    x = wp.float64(2.0) * field.half_x / wp.float64(field.cols - 1) * wp.float64(col)
    y = wp.float64(2.0) * field.half_y / wp.float64(field.rows - 1) * wp.float64(row)
    z = field.scale * wp.float64(heights[field.first_height + row * field.cols + col])
    return wp.vec3d(x - field.half_x, y - field.half_y, z)


@wp.func
def wall_normal(field: FieldPart, p: wp.vec3):
    """Normal of the side, the bottom or the floor next to ``p``."""
    base = float(field.base)
    gap_x = wp.abs(wp.abs(p[0]) - float(field.half_x))
    gap_y = wp.abs(wp.abs(p[1]) - float(field.half_y))
    gap_z = wp.min(wp.abs(p[2]), wp.abs(p[2] + base))
    if gap_x <= gap_y and gap_x <= gap_z:
        return wp.vec3(wp.sign(p[0]), 0.0, 0.0)
    if gap_y <= gap_z:
        return wp.vec3(0.0, wp.sign(p[1]), 0.0)
    return wp.vec3(0.0, 0.0, wp.where(p[2] + 0.5 * base > 0.0, 1.0, -1.0))


@wp.func
def heightfield_normal(field: FieldPart, heights: wp.array(dtype=wp.float32), face: int, p: wp.vec3):
    """Outward unit normal of a face."""
    if face == WALL:
        return wall_normal(field, p)
    row = face / 2 / field.cols
    col = face / 2 % field.cols
    a = heightfield_corner(field, heights, row, col)
    b = heightfield_corner(field, heights, row + 1, col + 1)
    c = heightfield_corner(field, heights, row + 1, col)
    if face % 2 == 0:
        c = b
        b = heightfield_corner(field, heights, row, col + 1)
    return wp.vec3(wp.normalize(wp.cross(b - a, c - a)))


@wp.func
def refine_heightfield(
    field: FieldPart, heights: wp.array(dtype=wp.float32), face: int, o: wp.vec3d, d: wp.vec3d, t: wp.float64
):
    """The crossing near ``t`` in float64."""
    if face == WALL:
        p = wp.vec3(o + t * d)
        n = wall_normal(field, p)
        plane = wp.vec3d(field.half_x, field.half_y, wp.float64(0.0))
        if n[2] < 0.0:
            plane[2] = field.base
        sine = wp.dot(wp.vec3d(n), d)
        offset = wp.dot(plane, wp.vec3d(wp.abs(n)))
        if wp.abs(sine) < wp.float64(1.0e-9):
            return t
        return wp.max((offset - wp.dot(wp.vec3d(n), o)) / sine, wp.float64(0.0))
    row = face / 2 / field.cols
    col = face / 2 % field.cols
    a = heightfield_corner(field, heights, row, col)
    b = heightfield_corner(field, heights, row + 1, col + 1)
    c = heightfield_corner(field, heights, row + 1, col)
    if face % 2 == 0:
        c = b
        b = heightfield_corner(field, heights, row, col + 1)
    return plane_through(a, b, c, o, d, t)
