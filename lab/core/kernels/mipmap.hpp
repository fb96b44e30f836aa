// The levels of a texture.
#pragma once

#include <cstdint>

#include "dispatch.hpp"

ENGRAM_DECLARE_KERNELS(
    // One level of a texture to the next: each texel the mean of the four it covers. With
    // keep_coverage the fourth channel is stretched so that the share of texels >= 128 stays.
    void halve_texture(const uint8_t *from, int32_t width, int32_t height, bool keep_coverage,
                       uint8_t *to);)
