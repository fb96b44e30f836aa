// Landmarks as they are stored: measurements rounded to their codes' values, and their points.
#pragma once

#include "dispatch.hpp"
#include "kernels/types.hpp"

namespace engram {

// See engram.frontend.blobs, where the tables come from.
struct Quanta {
  float step_px;            // a power of two
  const float *sigma_px;    // value of each of `codes` codes
  const float *sigma_borders_px; // codes − 1, between neighbouring codes
  int codes;
};

// Rounded in place; `points_in_cam` is written.
struct QuantisedLandmarks {
  int64_t count;
  float *pixels, *disparity_px, *sigma_px, *points_in_cam;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // Rounds pixels, disparities and their σ to the values of the nearest codes, and triangulates.
    // False if a pixel or a disparity has no code in 16 bits.
    bool quantise_landmarks(const QuantisedLandmarks &landmarks, const Quanta &quanta,
                            const Camera &camera);)
