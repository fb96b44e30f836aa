// Stereo by search along the row: corners in the left image only, their disparity in the right one.
#pragma once

#include "dispatch.hpp"
#include "kernels/image.hpp"

namespace engram {

// Both images of a rectified pair, and both halved. Where the sides differ in brightness, the halved
// ones are freed of it (even_contrast), and windows of the others are.
struct StereoImages {
  Image left, right, left_half, right_half;
  bool sides_differ = false;
};

struct StereoSettings {
  int32_t max_disparity_px;
  float min_disparity_px;
  // The best cost of the search must lie below this share of the best one elsewhere on the row.
  float uniqueness;
  // What differs between the matched windows may make up this share of the left one's variance.
  float max_residual;
  // Landmarks whose disparity is less certain are left out.
  float max_sigma_px;
  // σ² = floor² + (scale · σ from image noise and gradient)².
  float sigma_floor_px, sigma_scale;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // Measures the disparity at corner x, y (at least corner_border inside the left image).
    // Returns false where there is none to be had: ambiguous, hidden in the right image, out of
    // bounds, too uncertain.
    //
    // 1. Search at half resolution: sum of truncated absolute differences over 7×7 pixels, all
    //    disparities; the best must be unique, and mutual (left-right check to ±1).
    // 2. At full resolution the best of the five integer disparities about it by the sum of
    //    absolute differences over 16×9 pixels.
    // 3. Sub-pixel: the zero of s(d) = Σ G (L(x) − R(x − d)), G = dL/dx, both freed of their means,
    //    which is the condition for the least sum of squares; s is exact in integers at whole d and
    //    interpolated linearly between. Being odd about the solution, s is far straighter there
    //    than a matching cost is parabolic: little of the usual pull towards whole pixels.
    // 4. σ: residual variance / Σ G².
    bool measure_disparity(const StereoImages &images, int64_t x, int64_t y,
                           const StereoSettings &settings, float *disparity_px, float *sigma_px);)
