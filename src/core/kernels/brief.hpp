// BRIEF-256 (Calonder et al., ECCV 2010), upright.
#pragma once

#include "dispatch.hpp"
#include "kernels/image.hpp"

ENGRAM_DECLARE_KERNELS(
    // The descriptor of the corner at x, y of a smoothed image, at least corner_border inside it:
    // four words, bit t of the 256 set where the pattern's first point is darker than its second.
    void describe(const Image &smoothed, const Corner *corners, int64_t count,
                  uint64_t *descriptors);)
