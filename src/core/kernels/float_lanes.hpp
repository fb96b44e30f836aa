// Vectors of a fixed number of lanes. Every instruction set sums in the same order, lane by lane
// and then the lanes from first to last, so that all of them give the same bits.
#pragma once

#include <cstdint>
#include <cstring>

namespace engram::ENGRAM_ISA {

constexpr int64_t kLanes = 16;

typedef float Floats __attribute__((vector_size(64)));
typedef int32_t Ints __attribute__((vector_size(64)));
typedef int16_t Shorts __attribute__((vector_size(64))); // 32 lanes

inline Floats load(const float *values) {
  Floats lanes;
  std::memcpy(&lanes, values, sizeof lanes);
  return lanes;
}

inline Shorts load(const int16_t *values) {
  Shorts lanes;
  std::memcpy(&lanes, values, sizeof lanes);
  return lanes;
}

inline void store(int16_t *values, Shorts lanes) { std::memcpy(values, &lanes, sizeof lanes); }

inline float sum(Floats lanes) {
  float total = 0;
  for (int lane = 0; lane < kLanes; ++lane)
    total += lanes[lane];
  return total;
}

inline int32_t sum(Ints lanes) {
  int32_t total = 0;
  for (int lane = 0; lane < kLanes; ++lane)
    total += lanes[lane];
  return total;
}

} // namespace engram::ENGRAM_ISA
