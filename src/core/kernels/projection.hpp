// Stereo projection of a point.
#pragma once

#include "kernels/rigid.hpp"

namespace engram::ENGRAM_ISA {

constexpr double kNearest_m = 0.1; // nothing closer can be seen by both cameras of a pair

// A stereo measurement is (left u, left v, disparity): left u, left v and right u = u − disparity,
// in coordinates whose errors are independent.
inline Vec3 project(const Camera &camera, const Vec3 &point) {
  const double inverse_z = 1 / point[2];
  return {camera.fx * point[0] * inverse_z + camera.cx, camera.fy * point[1] * inverse_z + camera.cy,
          camera.fx * camera.baseline_m * inverse_z};
}

} // namespace engram::ENGRAM_ISA
