// The luminance of every pixel, from the visibility buffer: textures, sun, sky, lamps, weather.
#pragma once

#include "dispatch.hpp"
#include "kernels/scene.hpp"

ENGRAM_DECLARE_KERNELS(
    // Rows [row_begin, row_end) of luminance (view.height, view.width), linear, from ids
    // (view.height · view.samples, view.width · view.samples). Each surface that a pixel sees is
    // shaded once, at the middle of the samples it covers there, and weighted by their number.
    void shade_view(const Surroundings &world, const Light &light, const View &view,
                    const int32_t *ids, int32_t row_begin, int32_t row_end, float *luminance);

    // Adds to rows [row_begin, row_end) of luminance what wet level ground mirrors of `shown`, the
    // same picture before. inverse_depths (view.height, view.width) are 1/z, 0 for the sky.
    void mirror_view(const Surroundings &world, const Light &light, const View &view,
                     const float *inverse_depths, const float *shown, int32_t row_begin,
                     int32_t row_end, float *luminance);)
