// Puts the candidates of a live frame in order.
#pragma once

#include <cstdint>
#include <vector>

#include "dispatch.hpp"

ENGRAM_DECLARE_KERNELS(
    // order = the rows 0 … count − 1 by key after key (each (count,)), smallest first, what is no
    // number last; then by their UUIDs (count, 2), high word and low word.
    void order_rows(const std::vector<const double *> &keys, int64_t count,
                    const uint64_t *uuid_words, int64_t *order);

    // result = g(along) g(across) / g(0) with g piecewise linear through the rates (2, bins) in the
    // middle of bins of one width, constant beyond the ends.
    void success_rates(const double *rates, int64_t bins, double bin_m, const double *along_m,
                       const double *across_m, int64_t count, double *result);)
