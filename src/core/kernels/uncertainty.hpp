// How uncertain a landmark of a frame is: its pixel, its disparity, its depth.
#pragma once

#include <cmath>

#include "kernels/rigid.hpp"
#include "kernels/types.hpp"

namespace engram::ENGRAM_ISA {

inline double power(double base, int exponent) {
  double result = 1;
  for (; exponent > 0; exponent >>= 1, base *= base)
    if (exponent & 1)
      result *= base;
  return result;
}

inline Vec3 point_of(const FrameView &frame, int32_t row) {
  const float *p = frame.points_in_cam + 3 * row;
  return {p[0], p[1], p[2]};
}

// While a pose is sought, the cameras' common disparity offsets count as noise of each landmark;
// once there is one, they are estimated.
enum class OffsetsAre { noise, estimated };

inline double disparity_variance(const FrameView &frame, int32_t row,
                                 const MatchSettings &settings, OffsetsAre offsets) {
  const double sigma = frame.disparity_sigma_px[row];
  const double views = settings.disparity_sigma_px;
  const double common = offsets == OffsetsAre::noise ? settings.offset_sigma_px : 0;
  return sigma * sigma + views * views + common * common;
}

inline double relative_depth_variance(const FrameView &frame, int32_t row,
                                      const MatchSettings &settings, OffsetsAre offsets) {
  const double disparity = frame.disparity_px[row];
  return disparity_variance(frame, row, settings, offsets) / (disparity * disparity);
}

inline double pixel_sigma(const FrameView &frame, int32_t row, const MatchSettings &settings) {
  return settings.pixel_sigma_px * std::sqrt(power(settings.octave_scale, frame.octaves[row]));
}

} // namespace engram::ENGRAM_ISA
