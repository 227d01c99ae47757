// How many of n keys come before key i: smaller ones, and equal ones before it.
inline int rank_of(array_t<int> keys, int env, int i, int n)
{
    const int* __restrict__ K = (const int*)((const char*)keys.data + (size_t)env * keys.strides[0]);
    const int key = K[i];
    int rank = 0;
    for (int j = 0; j < i; ++j) rank += K[j] <= key;
    for (int j = i + 1; j < n; ++j) rank += K[j] < key;
    return rank;
}
