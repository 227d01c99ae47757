// Exact farthest point sampling of one environment, shared by the threads of a CUDA block or run by one CPU thread.
//
// Picks min(n, num_picks) of n points, the first of them point 0. Each further one has the largest distance to its nearest
// picked point; of equally far points the first wins, and none is picked twice. Squared distances are kept as the
// integers of their bits: floats that are not negative order alike, integer minima and maxima vectorise without fast-math,
// and -1 marks what has been picked.
//
// The arrays have a row for each environment: coordinates x, y, z; distance is work memory; picked is the result. Of a CUDA
// block, lane i may have written only the points i, i + num_lanes, ... and may read only those picks afterwards.
inline void farthest_points(array_t<float> x, array_t<float> y, array_t<float> z, array_t<int> distance,
                            array_t<int> picked, int n, int num_picks, int env, int lane, int num_lanes)
{
    int* P = picked.data + (size_t)env * (picked.strides[0] / sizeof(int));
    if (n <= num_picks) {
        for (int i = lane; i < n; i += num_lanes) P[i] = i;
        return;
    }
    const size_t row = (size_t)env * (x.strides[0] / sizeof(float));
    const float* __restrict__ X = x.data + row;
    const float* __restrict__ Y = y.data + row;
    const float* __restrict__ Z = z.data + row;
    int* __restrict__ D = distance.data + (size_t)env * (distance.strides[0] / sizeof(int));
    const int farther_than_all = 0x7f7fffff;  // the largest finite float
    for (int i = lane; i < n; i += num_lanes) D[i] = farther_than_all;
    int current = 0;
#if defined(__CUDA_ARCH__)
    // Three slots, so that a slot is cleared two barriers before its next use.
    __shared__ unsigned long long best[3];
    __syncthreads();
    if (lane < 3) best[lane] = 0ull;
    __syncthreads();
    for (int s = 0; s < num_picks; ++s) {
        if (lane == 0) {
            P[s] = current;
            best[(s + 1) % 3] = 0ull;
        }
        if (lane == current % num_lanes) D[current] = -1;
        const float cx = X[current], cy = Y[current], cz = Z[current];
        unsigned long long mine = 0ull;
        for (int i = lane; i < n; i += num_lanes) {
            const float dx = X[i] - cx, dy = Y[i] - cy, dz = Z[i] - cz;
            const int d = min(D[i], __float_as_int(dx * dx + dy * dy + dz * dz));
            D[i] = d;
            if (d >= 0) {
                const unsigned long long key = ((unsigned long long)d << 32) | (unsigned int)~i;
                if (key > mine) mine = key;
            }
        }
        for (int step = 16; step > 0; step >>= 1) {
            const unsigned long long other = __shfl_down_sync(0xffffffffu, mine, step);
            if (other > mine) mine = other;
        }
        if ((lane & 31) == 0) atomicMax(&best[s % 3], mine);
        __syncthreads();
        current = (int)~(unsigned int)(best[s % 3] & 0xffffffffull);
    }
#else
    for (int s = 0; s < num_picks; ++s) {
        P[s] = current;
        D[current] = -1;
        const float cx = X[current], cy = Y[current], cz = Z[current];
        int farthest = -1;
        for (int i = 0; i < n; ++i) {
            const float dx = X[i] - cx, dy = Y[i] - cy, dz = Z[i] - cz;
            const float squared = dx * dx + dy * dy + dz * dz;
            int bits;
            memcpy(&bits, &squared, sizeof(bits));
            const int d = D[i] < bits ? D[i] : bits;
            D[i] = d;
            farthest = farthest > d ? farthest : d;
        }
        current = 0;
        while (current < n - 1 && D[current] != farthest) ++current;
    }
#endif
}
