// FAST-9 corners and their choice, spread over the image.
#pragma once

#include "dispatch.hpp"
#include "kernels/image.hpp"

namespace engram {

// Corners lie this far inside the image at least, so that the descriptor's smoothed 31×31 patch
// does, too.
constexpr int64_t corner_border = 17;

// Scores are kept in rows of this length: vectors overrun the end of the image's.
constexpr int64_t score_stride(int64_t width) { return width + 128; }

// No more corners than this pass non-maximum suppression: no two are neighbours.
constexpr int64_t most_corners(int64_t width, int64_t height) {
  return ((width + 1) / 2) * ((height + 1) / 2);
}

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // Finds the corners of FAST-9 (Rosten & Drummond, ECCV 2006) in raster order and returns their
    // number. The score is the smallest threshold at which the pixel is no corner any more; kept
    // are scores above `threshold` that are local maxima of their 3×3 neighbourhood (of equal
    // ones, the last in raster order). `corners` has room for most_corners(), `scores` for
    // score_stride() · height; scores are left there wherever refine_corner() will look.
    int64_t detect_corners(const Image &image, int threshold, Corner *corners, uint8_t *scores);

    // Where the corner lies to a fraction of a pixel, in [-0.45, 0.45] about it: the peaks of two
    // parabolas, along x and y, through the scores smoothed with 1 2 1 in both directions. On real
    // images this halves the error of a corner's place, from 0.5 to 0.3 px.
    void refine_corner(const Corner &corner, const uint8_t *scores, int64_t width, float *offset);

    // Orders corners so that any first n of them are spread over the image as evenly as it allows:
    // first the best corner of each square cell, then the second best of each, and so on; within
    // such a round by score. Ties keep raster order. Writes `count` indices.
    void order_corners(const Corner *corners, int64_t count, const Image &image, int64_t cell_px,
                       int32_t *order);)
