// The same picks as farthest_points.h, ties included, by one CPU thread that leaves out points too near to be picked next.
//
// The points are sorted into buckets of 32 neighbours. A new pick can only lower the distances in a bucket whose box is
// nearer to it than the bucket's farthest point is to the picks before it; all other buckets are skipped. Picking 280 points
// is 1.75 times as fast among 16,000 of them, 1.15 times among 1600 (docs/lab/perception.md).
//
// work is a row of memory for each environment, WORDS_PER_BUCKET of kernels.py for each bucket. CUDA compiles nothing of this.
inline void farthest_points_by_bucket(array_t<float> x, array_t<float> y, array_t<float> z, array_t<int> picked,
                                      array_t<int> work, int n, int num_picks, int env)
{
#if !defined(__CUDA_ARCH__)
    constexpr int SIZE = 32, CELLS = 16, BLOCK = 16;
    const int farther_than_all = 0x7f7fffff;  // the bits of the largest finite float
    const int num_buckets = (n + SIZE - 1) / SIZE, padded = num_buckets * SIZE;
    const float* in[3] = {(const float*)((const char*)x.data + (size_t)env * x.strides[0]),
                          (const float*)((const char*)y.data + (size_t)env * y.strides[0]),
                          (const float*)((const char*)z.data + (size_t)env * z.strides[0])};
    int* P = (int*)((char*)picked.data + (size_t)env * picked.strides[0]);
    int* rest = (int*)((char*)work.data + (size_t)env * work.strides[0]);
    auto take = [&rest](int count) {
        int* taken = rest;
        rest += count;
        return taken;
    };
    float* sorted[3];
    float* low[3];
    float* high[3];
    int* __restrict__ I = take(padded);       // place of each sorted point in x, y, z
    int* __restrict__ D = take(padded);       // bits of its squared distance to the nearest pick
    int* __restrict__ M = take(num_buckets);  // the largest of them in each bucket
    for (int a = 0; a < 3; ++a) {
        sorted[a] = (float*)take(padded);
        low[a] = (float*)take(num_buckets);
        high[a] = (float*)take(num_buckets);
    }

    // Sort by cell of a grid over the cloud along a Z-curve, so that consecutive points are near each other.
    float least[3], scale[3];
    for (int a = 0; a < 3; ++a) {
        float lo = in[a][0], hi = in[a][0];
        for (int i = 1; i < n; ++i) {
            lo = in[a][i] < lo ? in[a][i] : lo;
            hi = in[a][i] > hi ? in[a][i] : hi;
        }
        least[a] = lo;
        scale[a] = hi > lo ? (float)CELLS / (hi - lo) : 0.0f;
    }
    static const unsigned short SPREAD[CELLS] = {0, 1, 8, 9, 64, 65, 72, 73, 512, 513, 520, 521, 576, 577, 584, 585};
    constexpr int NUM_CELLS = CELLS * CELLS * CELLS;
    int starts[NUM_CELLS + 1];
    for (int c = 0; c <= NUM_CELLS; ++c) starts[c] = 0;
    for (int i = 0; i < n; ++i) {
        int key = 0;
        for (int a = 0; a < 3; ++a) {
            int cell = (int)((in[a][i] - least[a]) * scale[a]);
            cell = cell < 0 ? 0 : (cell > CELLS - 1 ? CELLS - 1 : cell);
            key |= SPREAD[cell] << a;
        }
        D[i] = key;
        ++starts[key + 1];
    }
    for (int c = 0; c < NUM_CELLS; ++c) starts[c + 1] += starts[c];
    int current = 0;
    for (int i = 0; i < n; ++i) {
        const int slot = starts[D[i]]++;
        if (i == 0) current = slot;
        I[slot] = i;
        for (int a = 0; a < 3; ++a) sorted[a][slot] = in[a][i];
    }
    for (int i = n; i < padded; ++i) {
        I[i] = 0x7fffffff;
        for (int a = 0; a < 3; ++a) sorted[a][i] = sorted[a][n - 1];
    }
    for (int i = 0; i < padded; ++i) D[i] = i < n ? farther_than_all : -1;
    for (int b = 0; b < num_buckets; ++b) {
        M[b] = farther_than_all;
        for (int a = 0; a < 3; ++a) {
            float lo = sorted[a][b * SIZE], hi = lo;
            for (int i = b * SIZE + 1; i < (b + 1) * SIZE; ++i) {
                lo = sorted[a][i] < lo ? sorted[a][i] : lo;
                hi = sorted[a][i] > hi ? sorted[a][i] : hi;
            }
            low[a][b] = lo;
            high[a][b] = hi;
        }
    }

    const float *__restrict__ X = sorted[0], *__restrict__ Y = sorted[1], *__restrict__ Z = sorted[2];
    const float *__restrict__ LX = low[0], *__restrict__ LY = low[1], *__restrict__ LZ = low[2];
    const float *__restrict__ HX = high[0], *__restrict__ HY = high[1], *__restrict__ HZ = high[2];
    for (int s = 0; s < num_picks; ++s) {
        P[s] = I[current];
        if (s == num_picks - 1) return;
        D[current] = -1;
        const int own = current / SIZE;
        const float cx = X[current], cy = Y[current], cz = Z[current];
        // Boxes are tested a block of buckets at a time, which vectorises.
        for (int first = 0; first < num_buckets; first += BLOCK) {
            const int last = first + BLOCK < num_buckets ? first + BLOCK : num_buckets;
            int is_near[BLOCK];
            int any_near = 0;
            for (int b = first; b < last; ++b) {
                float dx = LX[b] - cx > cx - HX[b] ? LX[b] - cx : cx - HX[b];
                float dy = LY[b] - cy > cy - HY[b] ? LY[b] - cy : cy - HY[b];
                float dz = LZ[b] - cz > cz - HZ[b] ? LZ[b] - cz : cz - HZ[b];
                dx = dx > 0.0f ? dx : 0.0f;
                dy = dy > 0.0f ? dy : 0.0f;
                dz = dz > 0.0f ? dz : 0.0f;
                const float squared = dx * dx + dy * dy + dz * dz;
                int bits;
                memcpy(&bits, &squared, sizeof(bits));
                is_near[b - first] = bits < M[b] || b == own;
                any_near |= is_near[b - first];
            }
            if (!any_near) continue;
            for (int b = first; b < last; ++b) {
                if (!is_near[b - first]) continue;
                int farthest = -1;
                for (int i = b * SIZE; i < (b + 1) * SIZE; ++i) {
                    const float dx = X[i] - cx, dy = Y[i] - cy, dz = Z[i] - cz;
                    const float squared = dx * dx + dy * dy + dz * dz;
                    int bits;
                    memcpy(&bits, &squared, sizeof(bits));
                    const int d = D[i] < bits ? D[i] : bits;
                    D[i] = d;
                    farthest = farthest > d ? farthest : d;
                }
                M[b] = farthest;
            }
        }
        int farthest = -1;
        for (int b = 0; b < num_buckets; ++b) farthest = farthest > M[b] ? farthest : M[b];
        int winner = 0x7fffffff;
        for (int b = 0; b < num_buckets; ++b) {
            if (M[b] != farthest) continue;
            for (int i = b * SIZE; i < (b + 1) * SIZE; ++i) {
                if (D[i] == farthest && I[i] < winner) {
                    winner = I[i];
                    current = i;
                }
            }
        }
    }
#endif
}
