// Index of the lowest bit that is set; one must be.

#pragma once
#include "warp/native/builtin.h"

inline int lowest_bit(int bits)
{
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz((unsigned int)bits);
#endif
}
