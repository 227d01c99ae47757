"""Many rays of one sensor through a height field in waves, for CPUs, where one ray alone waits for every step."""

import warp as wp

from .geometry import REFINE
from .heightfield import LEVEL_SHIFT, FieldPart

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""The most rays that are walked at once."""
REACHES = (2, 8, 32, 128)
"""Cells by which the windows of highest points reach beyond their block of 4 x 4 cells."""
UNKNOWN = wp.constant(-3)
"""The face of a ray that these waves leave to ``meet_heightfield``."""

# A step of a walk waits for the one before it, and hardly a branch of it can be foretold: a ray alone leaves most of a
# core idle. Here all rays of a block take a step each, and lists of those that go on are kept without branches, so that
# steps of different rays overlap. A ray first jumps over windows: in a window, and above its highest point, it
# meets nothing, and the window that lets it go farthest counts. Where none allows half a cell, it visits its cell, as
# ``meet_heightfield`` does. Rays that do not start above the surface, and the rare one that rounding takes through it,
# are left to that function.
_WALK_BLOCK = """
    constexpr int most = BLOCK;
    const float tiny = 1.0e-12f;
    const int n = last - first;
    float* const t_row = t_out.data + size_t(env) * (t_out.strides[0] / sizeof(float)) + first;
    float* const slope_row = slope_out.data + size_t(env) * (slope_out.strides[0] / sizeof(float)) + first;
    int* const face_row = face_out.data + size_t(env) * (face_out.strides[0] / sizeof(int)) + first;
    const int cols = field.cols, last_x = field.cols - 2, last_y = field.rows - 2;
    const double grid_x = (o[0] + field.half_x) * field.per_x;
    const double grid_y = (o[1] + field.half_y) * field.per_y;
    if (!(grid_x >= 0.0 && grid_y >= 0.0 && grid_x <= last_x + 1 && grid_y <= last_y + 1 && o[2] > 0.0)) {
        for (int i = 0; i < n; ++i)
            face_row[i] = UNKNOWN;
        return;
    }
    const int near_x = (int)grid_x, near_y = (int)grid_y;
    const float gx = (float)(grid_x - near_x), gy = (float)(grid_y - near_y);
    const float per_x = (float)field.per_x, per_y = (float)field.per_y, unit = 1.0f / (float)field.scale;
    const float height = (float)o[2], oz = height * unit;
    const float margin = 1.0e-5f * (float)(field.half_x + field.half_y) * unit;
    const float floor_z = -margin - oz, ceiling_z = field.top + margin - oz;
    const float west = -near_x - gx, east = last_x + 1 - near_x - gx;
    const float south = -near_y - gy, north = last_y + 1 - near_y - gy;
    const float* const h = heights.data + field.first_height;
    const float* const window = (const float*)(windows.data + field.first_window);
    const int window_cols = field.window_cols;
    float ax[most], ay[most], az[most], dx[most], dy[most], dz[most], inv_x[most], inv_y[most], fall[most], cell[most];
    float t[most], end[most];
    int ix[most], iy[most], seen[most], todo[most], cells[most], close[most];
    for (int i = 0; i < n; ++i) {
        int at = steps + first + i;
        if (at >= cycle)
            at %= cycle;
        const float* d = (const float*)(directions.data + start + at);
        ax[i] = d[0];
        ay[i] = d[1];
        az[i] = d[2];
    }
    const float m00 = axes.data[0][0], m01 = axes.data[0][1], m02 = axes.data[0][2];
    const float m10 = axes.data[1][0], m11 = axes.data[1][1], m12 = axes.data[1][2];
    const float m20 = axes.data[2][0], m21 = axes.data[2][1], m22 = axes.data[2][2];
    for (int i = 0; i < n; ++i) {
        const float x = (m00 * ax[i] + m01 * ay[i] + m02 * az[i]) * per_x;
        const float y = (m10 * ax[i] + m11 * ay[i] + m12 * az[i]) * per_y;
        const float z = (m20 * ax[i] + m21 * ay[i] + m22 * az[i]) * unit;
        const float abs_x = x < 0.0f ? -x : x, abs_y = y < 0.0f ? -y : y, abs_z = z < 0.0f ? -z : z;
        const float big_x = abs_x > tiny ? abs_x : tiny, big_y = abs_y > tiny ? abs_y : tiny;
        const float ix_ = (x < 0.0f ? -1.0f : 1.0f) / big_x, iy_ = (y < 0.0f ? -1.0f : 1.0f) / big_y;
        const float iz_ = (z < 0.0f ? -1.0f : 1.0f) / (abs_z > tiny ? abs_z : tiny);
        const float out_x = (x < 0.0f ? west : east) * ix_, out_y = (y < 0.0f ? south : north) * iy_;
        const float below = floor_z * iz_, above = ceiling_z * iz_;
        float from = below < above ? below : above, to = below < above ? above : below;
        from = from > 0.0f ? from : 0.0f;
        to = to < out_x ? to : out_x;
        to = to < out_y ? to : out_y;
        dx[i] = x;
        dy[i] = y;
        dz[i] = z;
        inv_x[i] = ix_;
        inv_y[i] = iy_;
        fall[i] = z < -tiny ? -iz_ : 1.0e30f;
        cell[i] = 1.0f / (big_x > big_y ? big_x : big_y);
        t[i] = from;
        end[i] = to < limit ? to : limit;
        int cx = near_x + (int)floorf(gx + from * x), cy = near_y + (int)floorf(gy + from * y);
        cx = cx > 0 ? cx : 0;
        cy = cy > 0 ? cy : 0;
        ix[i] = cx < last_x ? cx : last_x;
        iy[i] = cy < last_y ? cy : last_y;
        seen[i] = 0;
        t_row[i] = INFINITY;
        slope_row[i] = 0.0f;
        face_row[i] = -1;
    }
    int count = 0;
    for (int i = 0; i < n; ++i) {
        todo[count] = i;
        count += t[i] <= end[i];
    }
    while (count > 0) {
        int kept = 0, stuck = 0, met = 0;
        for (int k = 0; k < count; ++k) {
            const int i = todo[k];
            const float* const high = window + 4 * ((iy[i] >> SHIFT) * window_cols + (ix[i] >> SHIFT));
            const float z = oz + t[i] * dz[i];
            float jump = 0.0f;
#pragma unroll
            for (int r = 0; r < 4; ++r) {
                const float inside = reach[r] * cell[i], over = (z - high[r]) * fall[i];
                const float both = inside < over ? inside : over;
                jump = jump > both ? jump : both;
            }
            const int jumps = jump > 0.5f * cell[i];
            const float next = t[i] + jump;
            const int goes_on = next < end[i];
            const float bounded = goes_on ? next : t[i];
            int cx = near_x + (int)floorf(gx + bounded * dx[i]), cy = near_y + (int)floorf(gy + bounded * dy[i]);
            cx = cx > 0 ? cx : 0;
            cy = cy > 0 ? cy : 0;
            cx = cx < last_x ? cx : last_x;
            cy = cy < last_y ? cy : last_y;
            t[i] = jumps ? bounded : t[i];
            ix[i] = jumps ? cx : ix[i];
            iy[i] = jumps ? cy : iy[i];
            seen[i] |= jumps;
            todo[kept] = i;
            kept += jumps & goes_on;
            cells[stuck] = i;
            stuck += !jumps;
        }
        for (int k = 0; k < stuck; ++k) {
            const int i = cells[k];
            const int forward_x = dx[i] >= 0.0f, forward_y = dy[i] >= 0.0f;
            const float t_x = ((float)(ix[i] + forward_x - near_x) - gx) * inv_x[i];
            const float t_y = ((float)(iy[i] + forward_y - near_y) - gy) * inv_y[i];
            const int along_x = t_x < t_y;
            float next = along_x ? t_x : t_y;
            next = next < end[i] ? next : end[i];
            next = next > t[i] ? next : t[i];
            const float z = oz + t[i] * dz[i], z_next = oz + next * dz[i];
            const float* const c = h + (iy[i] * cols + ix[i]);
            const float low_z = z < z_next ? z : z_next;
            const float high_s = c[0] > c[1] ? c[0] : c[1], high_n = c[cols] > c[cols + 1] ? c[cols] : c[cols + 1];
            const int meets = low_z <= (high_s > high_n ? high_s : high_n);
            const int passes = !meets;
            const int cx = ix[i] + (along_x ? 2 * forward_x - 1 : 0), cy = iy[i] + (along_x ? 0 : 2 * forward_y - 1);
            t[i] = passes ? next : t[i];
            ix[i] = passes ? cx : ix[i];
            iy[i] = passes ? cy : iy[i];
            seen[i] |= passes;
            close[met] = i;
            met += meets;
            todo[kept] = i;
            kept += passes & (next < end[i]) & (cx >= 0) & (cy >= 0) & (cx <= last_x) & (cy <= last_y);
        }
        for (int k = 0; k < met; ++k) {
            const int i = close[k];
            const int forward_x = dx[i] >= 0.0f, forward_y = dy[i] >= 0.0f;
            const float x0 = (float)(ix[i] - near_x) - gx, y0 = (float)(iy[i] - near_y) - gy;
            const float t_x = (x0 + forward_x) * inv_x[i], t_y = (y0 + forward_y) * inv_y[i];
            float next = t_x < t_y ? t_x : t_y;
            next = next < end[i] ? next : end[i];
            next = next > t[i] ? next : t[i];
            const float z = oz + t[i] * dz[i], z_next = oz + next * dz[i];
            const float* const c = h + (iy[i] * cols + ix[i]);
            const float h00 = c[0], h10 = c[1], h01 = c[cols], h11 = c[cols + 1];
            const float u = t[i] * dx[i] - x0, v = t[i] * dy[i] - y0;
            const float u_next = next * dx[i] - x0, v_next = next * dy[i] - y0;
            float over = z - h00 - (u >= v ? u * (h10 - h00) + v * (h11 - h10) : u * (h11 - h01) + v * (h01 - h00));
            float over_next = z_next - h00
                - (u_next >= v_next ? u_next * (h10 - h00) + v_next * (h11 - h10)
                                    : u_next * (h11 - h01) + v_next * (h01 - h00));
            float from = t[i], to = next;
            int triangle = u_next >= v_next ? 0 : 1;
            const float across = u - v, across_next = u_next - v_next;
            if (across * across_next < 0.0f) {
                const float f = across / (across - across_next);
                const float over_mid = z + f * (z_next - z) - h00 - (u + f * (u_next - u)) * (h11 - h00);
                const float t_mid = from + f * (next - from);
                if (over <= 0.0f || over_mid <= 0.0f) {
                    to = t_mid;
                    over_next = over_mid;
                    triangle = across >= 0.0f ? 0 : 1;
                } else {
                    from = t_mid;
                    over = over_mid;
                }
            }
            if (over <= 0.0f && !seen[i]) {
                face_row[i] = UNKNOWN;
            } else if (over <= 0.0f || over_next <= 0.0f) {
                const float rise_x = (triangle == 0 ? h10 - h00 : h11 - h01) * per_x;
                const float rise_y = (triangle == 0 ? h11 - h10 : h01 - h00) * per_y;
                const float into = dz[i] - (triangle == 0 ? h10 - h00 : h11 - h01) * dx[i]
                    - (triangle == 0 ? h11 - h10 : h01 - h00) * dy[i];
                const float at = over > 0.0f ? from + (to - from) * over / (over - over_next) : from;
                const float slope = fabsf(into) / sqrtf(unit * unit + rise_x * rise_x + rise_y * rise_y);
                t_row[i] = at;
                slope_row[i] = slope * (1.0f + at) * REFINE < at + height ? -1.0f : slope;
                face_row[i] = 2 * (iy[i] * cols + ix[i]) + triangle;
            } else {
                t[i] = next;
                seen[i] = 1;
                if (t_x < t_y)
                    ix[i] += 2 * forward_x - 1;
                else
                    iy[i] += 2 * forward_y - 1;
                todo[kept] = i;
                if (next < end[i] && ix[i] >= 0 && iy[i] >= 0 && ix[i] <= last_x && iy[i] <= last_y)
                    ++kept;
                else if (z_next <= 0.0f)
                    face_row[i] = UNKNOWN;
            }
        }
        count = kept;
    }
"""
_SLACK = 0.05  # cells by which rounding may misplace a ray
_WALK_BLOCK = "    const float reach[4] = {" + ", ".join(f"{r - _SLACK}f" for r in REACHES) + "};" + _WALK_BLOCK
_WALK_BLOCK = _WALK_BLOCK.replace("BLOCK", str(BLOCK)).replace("UNKNOWN", str(int(UNKNOWN)))
_WALK_BLOCK = _WALK_BLOCK.replace("REFINE", f"{float(REFINE)}f").replace("SHIFT", str(int(LEVEL_SHIFT)))


@wp.func_native(_WALK_BLOCK)
def walk_block(
    field: FieldPart,
    heights: wp.array(dtype=wp.float32),
    windows: wp.array(dtype=wp.vec4),
    directions: wp.array(dtype=wp.vec3),
    start: int,
    cycle: int,
    steps: int,
    first: int,
    last: int,
    o: wp.vec3d,
    axes: wp.mat33,
    limit: float,
    env: int,
    t_out: wp.array2d(dtype=wp.float32),
    slope_out: wp.array2d(dtype=wp.float32),
    face_out: wp.array2d(dtype=wp.int32),
):
    """What ``meet_heightfield`` finds for rays ``first`` to ``last`` of an environment, all from ``o``.

    Their directions, turned by ``axes``, are rows ``start + (steps + ray) % cycle``. The slope is negative where the
    distance is ``uncertain``; as ``o`` has float64, the field's centre may be far away without making it so.
    """
    ...
