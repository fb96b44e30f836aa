// Sums over an inverted index.
#pragma once

#include "place_index.hpp"

#include "dispatch.hpp"

ENGRAM_DECLARE_KERNELS(
    // sums[p] += the weights of those of the words that place p shows, in the order given.
    void add_weights(const PlaceIndex &index, const int32_t *words, const double *weights,
                     int64_t count, double *sums);

    // The same for a block of `places` places; false where a list leads out of it.
    bool add_weights(const SealedBlock &block, const int32_t *words, const double *weights,
                     int64_t count, double *sums, int64_t places);)
