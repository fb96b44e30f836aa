// Distances between binary descriptors of `width` 64-bit words each.
#pragma once

#include <cstdint>

#include "dispatch.hpp"

ENGRAM_DECLARE_KERNELS(
    // distances[i * b_count + j] = number of bits in which a[i] and b[j] differ.
    void hamming_matrix(const uint64_t *a, int64_t a_count, const uint64_t *b, int64_t b_count,
                        int width, uint16_t *distances);)
