// Vectors of eight doubles; see float_lanes.hpp for why all instruction sets give the same bits.
#pragma once

#include <array>
#include <cstdint>

#include "kernels/pack.hpp"

namespace engram::ENGRAM_ISA {

constexpr int kDoubleLanes = 8;
typedef Pack<double, kDoubleLanes> Doubles;
typedef Pack<int64_t, kDoubleLanes> Longs;

typedef std::array<Doubles, 3> Vec3Lanes;

inline double sum(const Doubles &lanes) {
  double total = 0;
  for (int lane = 0; lane < kDoubleLanes; ++lane)
    total += lanes[lane];
  return total;
}

// IEEE 754 fixes it to the last bit.
inline Doubles square_root(const Doubles &lanes) {
  Doubles result;
  for (int k = 0; k < Doubles::kParts; ++k)
    for (int lane = 0; lane < kDoubleLanes / Doubles::kParts; ++lane)
      result.part[k][lane] = __builtin_sqrt(lanes.part[k][lane]);
  return result;
}

inline Doubles dot(const Vec3Lanes &a, const Vec3Lanes &b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

inline Vec3Lanes cross(const Vec3Lanes &a, const Vec3Lanes &b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

} // namespace engram::ENGRAM_ISA
