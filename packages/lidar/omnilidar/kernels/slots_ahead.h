// Which of the first `count` of a word's 32 slots a ray along d may hit, one bit each: the sphere around a slot's shape, as x, y, z and a
// threshold, is ahead if (d . c) |d . c| >= threshold; that of a slot that is not in use is infinite. A CPU compares all 32,
// because its compiler turns a loop of fixed length into vector instructions.

#pragma once
#include "warp/native/builtin.h"

inline int slots_ahead(wp::array_t<float> words, int env, int word, int count, float dx, float dy, float dz)
{
    constexpr int word_size = 32;
    constexpr int n = word_size;
    const float* __restrict__ x = words.data + (size_t)env * (words.strides[0] / sizeof(float)) + word * (4 * n);
    int bits = 0;
#if defined(__CUDA_ARCH__)
    const int last = count < n ? count : n;
#else
    constexpr int last = n;
#endif
    for (int k = 0; k < last; ++k) {
        const float ahead = dx * x[k] + dy * x[n + k] + dz * x[2 * n + k];
        bits |= (ahead * fabsf(ahead) >= x[3 * n + k]) ? (int)(1u << k) : 0;
    }
    return bits;
}
