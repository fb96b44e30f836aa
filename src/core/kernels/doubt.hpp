// What the residuals of inliers do not show of a pose's error: they agree by choice. Of few, a large
// share agrees by chance or has moved with the light, as the edges of shadows do; and what is left
// of rectification and focal lengths is the same for all of them.
#pragma once

#include "kernels/twist.hpp"
#include "kernels/types.hpp"

namespace engram::ENGRAM_ISA {

inline double squared(double value) { return value * value; }

// Variances grow by so much where `few_inliers` would be usual and so many agree.
inline double growth_of_few(double few_inliers, double inliers) {
  return 1 + squared(few_inliers / inliers);
}

// What a search near the pose allows for: wider, more landmarks look alike.
inline Covariance searched(Covariance covariance, double inliers, const MatchSettings &settings) {
  for (double &entry : covariance)
    entry *= 1 + inliers / settings.independent_landmarks;
  return covariance;
}

// The covariance of a pose that many landmarks agree on, from that by their residuals alone.
inline Covariance doubted(Covariance covariance, double growth, double inliers, const Vec3 &moved_m,
                          const MatchSettings &settings) {
  for (double &entry : covariance)
    entry *= growth;
  const double shift = squared(settings.displaced_m / inliers) + squared(settings.calibration_m) +
                       squared(settings.calibration_share * norm(moved_m));
  for (int axis = 0; axis < 3; ++axis) {
    covariance[7 * axis] += shift;
    covariance[7 * (3 + axis)] += squared(settings.calibration_rad);
  }
  return covariance;
}

} // namespace engram::ENGRAM_ISA
