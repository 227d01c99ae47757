// The nearest triangle of a mesh that a ray hits: a descent of a tree of boxes, four at a time.
//
// The descent is front to back, and what lies behind the best hit is not entered. Triangles are tested after Woop,
// Benthin and Wald (2013): the corners are sheared into a frame in which the ray is the z axis, and the signs of three
// edge functions decide. Two triangles that share an edge compute its function from the same numbers, and products are
// rounded one by one, so a ray cannot pass between them. A crossing so near that rounding could put it behind the origin
// is decided in float64.
//
// Written in C++ so that the compiler turns the loops over four boxes and four triangles into vector instructions.

#pragma once
#include "warp/native/builtin.h"

// Returns (distance, face, sine of the angle of incidence); infinite, -1 and 0 for a miss.
inline wp::vec_t<3, double> descend(
    wp::array_t<wp::vec4> bounds,
    wp::array_t<wp::vec4i> child,
    wp::array_t<wp::vec4> triangles,
    int first_child,
    int first_node,
    int first_leaf,
    wp::vec3 o,
    wp::vec3 d,
    wp::vec3 inv,
    float limit)
{
    constexpr int stack_size = 64;
    constexpr float none = 3.0e38f;
    // A box's far side is moved away by this fraction of its distance, so that no rounding hides a triangle in it.
    constexpr float box_slack = 2.0e-6f;
#if defined(__clang__) && !defined(__CUDACC__)
#define LANES _Pragma("clang loop vectorize_width(4) interleave_count(1) unroll(disable)")
#else
#define LANES
#endif
#if defined(__CUDA_ARCH__)
#define PRODUCT(a, b) __fmul_rn(a, b)
#else
#define PRODUCT(a, b) ((a) * (b))
#endif
    const float ox = o[0], oy = o[1], oz = o[2], ix = inv[0], iy = inv[1], iz = inv[2];
    const int near_x = ix < 0.0f ? 3 : 0, near_y = iy < 0.0f ? 4 : 1, near_z = iz < 0.0f ? 5 : 2;
    const int ex = wp::abs(d[0]) >= wp::abs(d[1]);
    const int kz = ex ? (wp::abs(d[0]) >= wp::abs(d[2]) ? 0 : 2) : (wp::abs(d[1]) >= wp::abs(d[2]) ? 1 : 2);
    const int kx = kz == 2 ? 0 : kz + 1, ky = kx == 2 ? 0 : kx + 1;
    const float sz = 1.0f / d[kz], sx = d[kx] * sz, sy = d[ky] * sz, px = o[kx], py = o[ky], pz = o[kz];
    int stack[stack_size];
    float stack_t[stack_size];
    int top = 0, node = 0, face = -1;
    float best = limit < none ? limit : none, t[4];
    while (true) {
        if (node >= 0) {
            // An inner node: the boxes of its four children; the nearest is entered, the others go on the stack.
            const float* box = (const float*)(bounds.data + size_t(first_node + node) * 6);
            const int* kids = (const int*)(child.data + size_t(first_child + node));
            const float *lx = box + 4 * near_x, *ly = box + 4 * near_y, *lz = box + 4 * near_z;
            const float *hx = box + 4 * (3 - near_x), *hy = box + 4 * (5 - near_y), *hz = box + 4 * (7 - near_z);
            LANES
            for (int k = 0; k < 4; ++k) {
                const float ax = (lx[k] - ox) * ix, ay = (ly[k] - oy) * iy, az = (lz[k] - oz) * iz;
                const float bx = (hx[k] - ox) * ix, by = (hy[k] - oy) * iy, bz = (hz[k] - oz) * iz;
                float enter = ax > ay ? ax : ay;
                enter = enter > az ? enter : az;
                enter = enter > 0.0f ? enter : 0.0f;
                float leave = bx < by ? bx : by;
                leave = (leave < bz ? leave : bz) * (1.0f + box_slack);
                leave = leave < best ? leave : best;
                t[k] = enter <= leave ? enter : none;
            }
            int next = 0;
            float next_t = none;
            for (int k = 0; k < 4; ++k) {
                if (t[k] < none) {
                    int far_child = kids[k];
                    float far_t = t[k];
                    if (far_t < next_t) {
                        far_child = next;
                        far_t = next_t;
                        next = kids[k];
                        next_t = t[k];
                    }
                    if (far_t < none) {
                        stack[top] = far_child;
                        stack_t[top++] = far_t;
                    }
                }
            }
            if (next_t < none) {
                node = next;
                continue;
            }
        } else {
            // A leaf: four triangles, rows of `triangles` being 3 * corner + axis.
            const int leaf = -1 - node;
            const float* corner = (const float*)(triangles.data + size_t(first_leaf + leaf) * 9);
            const float *xa = corner + 4 * kx, *ya = corner + 4 * ky, *za = corner + 4 * kz;
            float margin[4];
            LANES
            for (int k = 0; k < 4; ++k) {
                const float az = za[k] - pz, bz = za[12 + k] - pz, cz = za[24 + k] - pz;
                const float ax = (xa[k] - px) - sx * az, ay = (ya[k] - py) - sy * az;
                const float bx = (xa[12 + k] - px) - sx * bz, by = (ya[12 + k] - py) - sy * bz;
                const float cx = (xa[24 + k] - px) - sx * cz, cy = (ya[24 + k] - py) - sy * cz;
                const float u1 = PRODUCT(cx, by), u2 = PRODUCT(cy, bx);
                const float v1 = PRODUCT(ax, cy), v2 = PRODUCT(ay, cx);
                const float w1 = PRODUCT(bx, ay), w2 = PRODUCT(by, ax);
                const float u = u1 - u2, v = v1 - v2, w = w1 - w2;
                float low = u < v ? u : v, high = u > v ? u : v;
                low = low < w ? low : w;
                high = high > w ? high : w;
                const float at = (u * az + v * bz + w * cz) / (u + v + w) * sz;
                margin[k] = (wp::abs(az) + wp::abs(bz) + wp::abs(cz)) * 1.0e-6f;
                const bool inside = (low >= 0.0f) | (high <= 0.0f);
                t[k] = (inside & (at < best) & (at > -margin[k])) ? at : none;
            }
            for (int k = 0; k < 4; ++k) {
                if (t[k] < best) {
                    float at = t[k];
                    if (at < margin[k]) {
                        double p[3], q[3], r[3], n[3];
                        for (int j = 0; j < 3; ++j) {
                            p[j] = (double)(corner[4 * j + k]) - (double)(o[j]);
                            q[j] = (double)(corner[12 + 4 * j + k]) - (double)(corner[4 * j + k]);
                            r[j] = (double)(corner[24 + 4 * j + k]) - (double)(corner[4 * j + k]);
                        }
                        n[0] = q[1] * r[2] - q[2] * r[1];
                        n[1] = q[2] * r[0] - q[0] * r[2];
                        n[2] = q[0] * r[1] - q[1] * r[0];
                        at = (float)((n[0] * p[0] + n[1] * p[1] + n[2] * p[2])
                            / (n[0] * d[0] + n[1] * d[1] + n[2] * d[2]));
                    }
                    if (at >= 0.0f && at < best) {
                        best = at;
                        face = 4 * leaf + k;
                    }
                }
            }
        }
        // The next node on the stack that is nearer than the best hit.
        bool found = false;
        while (top > 0 && !found) {
            --top;
            node = stack[top];
            found = stack_t[top] < best;
        }
        if (!found)
            break;
    }
#undef LANES
#undef PRODUCT
    if (face < 0)
        return wp::vec_t<3, double>((double)INFINITY, -1.0, 0.0);
    const float* corner = (const float*)(triangles.data + size_t(first_leaf + face / 4) * 9) + face % 4;
    const float qx = corner[12] - corner[0], qy = corner[16] - corner[4], qz = corner[20] - corner[8];
    const float rx = corner[24] - corner[0], ry = corner[28] - corner[4], rz = corner[32] - corner[8];
    const float nx = qy * rz - qz * ry, ny = qz * rx - qx * rz, nz = qx * ry - qy * rx;
    const float square = nx * nx + ny * ny + nz * nz;
    const float sin_incidence = square > 0.0f ? wp::abs(nx * d[0] + ny * d[1] + nz * d[2]) / sqrt(square) : 0.0f;
    return wp::vec_t<3, double>((double)best, (double)face, (double)sin_incidence);
}
