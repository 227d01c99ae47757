// Many rays of one sensor through a height field in waves, for CPUs.
//
// A step of a march depends on the one before it, and most of its branches are mispredicted: a ray alone leaves most of a
// core idle. Here all rays of a block take a step each, and lists of those that go on are kept without branches, so that
// steps of different rays overlap. A ray first jumps over windows: in a window, and above its highest point, it hits
// nothing, and the window that lets it go farthest counts. Where none allows half a cell, it visits its cell, as
// intersect_heightfield does. Rays that do not start above the surface, and the rare one that rounding takes through it,
// are left to that function.

#pragma once
#include "warp/native/builtin.h"

// One height field of a scene, as Warp generates it from FieldPart in heightfield.py.
struct FieldPart {
    int rows, cols;
    double half_x, half_y, base, scale, per_x, per_y;
    float top;
    int first_height, first_level, top_level, first_window, window_cols;
};

// What intersect_heightfield finds for rays `first` to `last` of an environment, all from `o` in the field's frame. Their
// directions, turned by `axes`, are rows `start + (steps + ray) % cycle`. A hit is uncertain, to be refined in float64,
// as geometry.uncertain says; as `o` has float64, the field's centre may be far away without making it so.
inline void march_block(
    FieldPart field,
    wp::array_t<float> heights,
    wp::array_t<wp::vec4> windows,
    wp::vec4 reaches,  // cells by which the windows reach beyond their block
    wp::array_t<wp::vec3> directions,
    int start,
    int cycle,
    int steps,
    int first,
    int last,
    wp::vec3d o,
    wp::mat33 axes,
    float limit,
    float refine,
    int env,
    wp::array_t<float> t_out,
    wp::array_t<int> face_out,
    wp::array_t<bool> uncertain_out)
{
    constexpr int block = 256;       // the most rays at once
    constexpr int not_marched = -3;  // the face of a ray that is left to intersect_heightfield
    constexpr int block_shift = 2;   // windows are there for blocks of 4 x 4 cells
    constexpr float slack = 0.05f;   // cells by which rounding may misplace a ray
    const float tiny = 1.0e-12f;
    const int n = last - first;
    float* const t_row = t_out.data + size_t(env) * (t_out.strides[0] / sizeof(float)) + first;
    bool* const uncertain_row = uncertain_out.data + size_t(env) * uncertain_out.strides[0] + first;
    int* const face_row = face_out.data + size_t(env) * (face_out.strides[0] / sizeof(int)) + first;
    const int cols = field.cols, last_x = field.cols - 2, last_y = field.rows - 2;
    const double grid_x = (o[0] + field.half_x) * field.per_x;
    const double grid_y = (o[1] + field.half_y) * field.per_y;
    if (!(grid_x >= 0.0 && grid_y >= 0.0 && grid_x <= last_x + 1 && grid_y <= last_y + 1 && o[2] > 0.0)) {
        for (int i = 0; i < n; ++i)
            face_row[i] = not_marched;
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
    const float reach[4] = {reaches[0] - slack, reaches[1] - slack, reaches[2] - slack, reaches[3] - slack};
    float ax[block], ay[block], az[block], dx[block], dy[block], dz[block], inv_x[block], inv_y[block];
    float fall[block], cell[block], t[block], end[block];
    int ix[block], iy[block], seen[block], todo[block], cells[block], close[block];
    // The rays' directions, from the table.
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
    // Each ray in grid units, and from where to where it is above the floor, below the highest point and in the grid.
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
        uncertain_row[i] = false;
        face_row[i] = -1;
    }
    int count = 0;  // rays under way, listed in todo
    for (int i = 0; i < n; ++i) {
        todo[count] = i;
        count += t[i] <= end[i];
    }
    while (count > 0) {
        int kept = 0, num_cells = 0, num_close = 0;
        // A jump as far as a window or the height above it allows; where that is half a cell, the cell is visited.
        for (int k = 0; k < count; ++k) {
            const int i = todo[k];
            const float* const high = window + 4 * ((iy[i] >> block_shift) * window_cols + (ix[i] >> block_shift));
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
            cells[num_cells] = i;
            num_cells += !jumps;
        }
        // A step through a cell, unless the ray dips below the highest of its corners.
        for (int k = 0; k < num_cells; ++k) {
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
            const int dips = low_z <= (high_s > high_n ? high_s : high_n);
            const int passes = !dips;
            const int cx = ix[i] + (along_x ? 2 * forward_x - 1 : 0), cy = iy[i] + (along_x ? 0 : 2 * forward_y - 1);
            t[i] = passes ? next : t[i];
            ix[i] = passes ? cx : ix[i];
            iy[i] = passes ? cy : iy[i];
            seen[i] |= passes;
            close[num_close] = i;
            num_close += dips;
            todo[kept] = i;
            kept += passes & (next < end[i]) & (cx >= 0) & (cy >= 0) & (cx <= last_x) & (cy <= last_y);
        }
        // The two triangles of such a cell: a crossing, or a step through the cell.
        for (int k = 0; k < num_close; ++k) {
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
                face_row[i] = not_marched;
            } else if (over <= 0.0f || over_next <= 0.0f) {
                const float rise_x = (triangle == 0 ? h10 - h00 : h11 - h01) * per_x;
                const float rise_y = (triangle == 0 ? h11 - h10 : h01 - h00) * per_y;
                const float into = dz[i] - (triangle == 0 ? h10 - h00 : h11 - h01) * dx[i]
                    - (triangle == 0 ? h11 - h10 : h01 - h00) * dy[i];
                const float at = over > 0.0f ? from + (to - from) * over / (over - over_next) : from;
                const float sine = fabsf(into) / sqrtf(unit * unit + rise_x * rise_x + rise_y * rise_y);
                t_row[i] = at;
                uncertain_row[i] = sine * (1.0f + at) * refine < at + height;
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
                    face_row[i] = not_marched;
            }
        }
        count = kept;
    }
}
