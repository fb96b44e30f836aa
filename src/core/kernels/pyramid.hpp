// Smoothing and halving of grey images.
#pragma once

#include "dispatch.hpp"
#include "kernels/image.hpp"

ENGRAM_DECLARE_KERNELS(
    // Binomial 5×5 blur (1 4 6 4 1 in both directions, σ = 1 px), rounded to nearest. The outer two
    // pixels of each side are left unwritten.
    void smooth(const Image &image, uint8_t *smoothed);

    // Mean of 2×2 pixels, rounded half up: (width / 2) × (height / 2), an odd last row or column
    // is dropped.
    void halve(const Image &image, uint8_t *half);)
