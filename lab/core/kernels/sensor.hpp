// From luminance to the grey levels that a camera delivers.
#pragma once

#include <cstdint>

#include "dispatch.hpp"

namespace engram {

struct Sensor {
  float gain;     // grey level 255 is luminance 1 / gain
  float shot;     // variance of the noise per unit of exposed luminance
  float read;     // its standard deviation in the dark
  float vignette; // loss of light in the corners
  uint64_t seed;  // of the noise
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // grey (height, width) from luminance: gain, vignette, noise, saturation, square-root curve.
    void develop(const float *luminance, int32_t width, int32_t height, const Sensor &sensor,
                 uint8_t *grey);

    // The picture smeared along the motion of its points while the shutter was open. twist is the
    // camera's motion in that time (translation m, rotation rad, in camera axes).
    void smear(const float *luminance, const float *inverse_depths, int32_t width, int32_t height,
               float fx, float fy, float cx, float cy, const float *twist, float *smeared);)
