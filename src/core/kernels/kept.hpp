// Landmarks that one frame has at the pixel where another frame of the same camera has them.
#pragma once

#include <cstdint>

#include "dispatch.hpp"
#include "kernels/types.hpp"

ENGRAM_DECLARE_KERNELS(
    // rows[i]: the landmark of `now` within a pixel both ways of landmark i of `before`, whole
    // pixels, whose descriptor differs in the fewest bits, the first of several; -1 where none
    // differs in at most so many bits and in so much disparity. Both are of one width.
    void kept_rows(const FrameView &before, const FrameView &now, int most_bits,
                   float most_disparity_px, int32_t *rows);)
