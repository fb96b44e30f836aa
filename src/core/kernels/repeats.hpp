// Whether a picture repeats an earlier one.
#pragma once

#include "dispatch.hpp"
#include "kernels/image.hpp"

namespace engram {

struct EqualPixels {
  int64_t telling, equal;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // How many pixels of a picture are lighter than black and darker than white, and how many of
    // those are as in another of its size.
    EqualPixels equal_pixels(const Image &now, const Image &before, uint8_t black, uint8_t white);)
