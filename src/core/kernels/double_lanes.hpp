// Vectors of eight doubles; see float_lanes.hpp for why all instruction sets give the same bits.
#pragma once

#include <array>
#include <cstdint>

namespace engram::ENGRAM_ISA {

typedef double Doubles __attribute__((vector_size(64)));
typedef int64_t Longs __attribute__((vector_size(64)));
constexpr int kDoubleLanes = 8;

typedef std::array<Doubles, 3> Vec3Lanes;

inline double sum(Doubles lanes) {
  double total = 0;
  for (int lane = 0; lane < kDoubleLanes; ++lane)
    total += lanes[lane];
  return total;
}

inline Doubles dot(const Vec3Lanes &a, const Vec3Lanes &b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

inline Vec3Lanes cross(const Vec3Lanes &a, const Vec3Lanes &b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

} // namespace engram::ENGRAM_ISA
