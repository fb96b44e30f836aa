// Sixteen triangles at once: the pose that carries each from the live camera onto its counterpart
// in the reference.
#pragma once

#include <array>
#include <vector>

#include "kernels/correspondences.hpp"
#include "kernels/float_lanes.hpp"

namespace engram::ENGRAM_ISA {

typedef Vec3Floats<kLanes> Points;

ENGRAM_INLINE Points minus(const Points &a, const Points &b) {
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}

ENGRAM_INLINE Floats dot(const Points &a, const Points &b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

ENGRAM_INLINE Points scaled(const Points &a, const Floats &by) {
  return {a[0] * by, a[1] * by, a[2] * by};
}

// 1 / √x; IEEE 754 fixes both to the last bit.
inline Floats inverse_root(const Floats &lanes) {
  Floats result;
  for (int k = 0; k < Floats::kParts; ++k)
    for (int lane = 0; lane < kLanes / Floats::kParts; ++lane)
      result.part[k][lane] = __builtin_sqrtf(lanes.part[k][lane]);
  return 1.0f / result;
}

struct Triangles {
  Points corner[3];

  void set(int lane, int which, const float *point) {
    for (int k = 0; k < 3; ++k)
      corner[which][k][lane] = point[k];
  }

  // Orthonormal axes along two sides. Returns where the corners do not lie nearly on a line.
  ENGRAM_INLINE Ints axes(Points *axis) const {
    constexpr float kLeastSine2 = 0.03f * 0.03f;
    const Points first = minus(corner[1], corner[0]), second = minus(corner[2], corner[0]);
    const Points normal = cross<kLanes>(first, second);
    const Floats length2 = dot(first, first), area2 = dot(normal, normal);
    const Ints wide = area2 > kLeastSine2 * length2 * dot(second, second);
    axis[0] = scaled(first, inverse_root(select(wide, length2, 1.0f)));
    axis[1] = scaled(normal, inverse_root(select(wide, area2, 1.0f)));
    axis[2] = cross<kLanes>(axis[0], axis[1]);
    return wide;
  }
};

// live_from_reference of sixteen pairs of triangles.
struct TrianglePoses {
  Floats m[9], t[3];
  Ints valid; // neither triangle is nearly a line, and the views are close enough

  TrianglePoses(const Triangles &reference, const Triangles &live, double least_cosine) {
    Points from[3], to[3];
    valid = reference.axes(from) & live.axes(to);
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 3; ++column)
        m[3 * row + column] = to[0][row] * from[0][column] + to[1][row] * from[1][column] +
                              to[2][row] * from[2][column];
    constexpr float kThird = 1.0f / 3;
    Points centre;
    for (int k = 0; k < 3; ++k)
      centre[k] = kThird * (reference.corner[0][k] + reference.corner[1][k] + reference.corner[2][k]);
    for (int k = 0; k < 3; ++k)
      t[k] = kThird * (live.corner[0][k] + live.corner[1][k] + live.corner[2][k]) -
             (m[3 * k] * centre[0] + m[3 * k + 1] * centre[1] + m[3 * k + 2] * centre[2]);
    valid = valid & (m[8] >= static_cast<float>(least_cosine));
  }

  FloatPose pose(int lane) const {
    FloatPose one;
    for (int k = 0; k < 9; ++k)
      one.m[k] = m[k][lane];
    for (int k = 0; k < 3; ++k)
      one.t[k] = t[k][lane];
    return one;
  }
};

} // namespace engram::ENGRAM_ISA
