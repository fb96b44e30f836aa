// Vectors of a fixed number of lanes. Every instruction set sums in the same order, lane by lane
// and then the lanes in halves, so that all of them give the same bits.
#pragma once

#include <array>
#include <cstdint>
#include <cstring>

#ifdef __AVX512BW__
#include <immintrin.h>
#endif

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

// In halves: lane 0 with lane 8 and so on.
inline float sum(Floats lanes) {
  lanes += __builtin_shuffle(lanes, Ints{8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7});
  lanes += __builtin_shuffle(lanes, Ints{4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3});
  return (lanes[0] + lanes[2]) + (lanes[1] + lanes[3]);
}

inline int32_t sum(Ints lanes) {
  int32_t total = 0;
  for (int lane = 0; lane < kLanes; ++lane)
    total += lanes[lane];
  return total;
}

typedef std::array<Floats, 3> Vec3Floats;

inline Vec3Floats cross(const Vec3Floats &a, const Vec3Floats &b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// Bit k says whether lane k of a comparison holds.
inline uint32_t bits_of(Ints lanes) {
#ifdef __AVX512BW__
  return _mm512_movepi32_mask((__m512i)lanes);
#else
  const Ints bit = {1,      1 << 1, 1 << 2,  1 << 3,  1 << 4,  1 << 5,  1 << 6,  1 << 7,
                    1 << 8, 1 << 9, 1 << 10, 1 << 11, 1 << 12, 1 << 13, 1 << 14, 1 << 15};
  return static_cast<uint32_t>(sum(lanes & bit));
#endif
}

inline uint32_t bits_of(Shorts lanes) {
#ifdef __AVX512BW__
  return _mm512_movepi16_mask((__m512i)lanes);
#else
  uint32_t bits = 0;
  uint64_t words[8];
  std::memcpy(words, &lanes, sizeof words);
  for (int word = 0; word < 8; ++word) // all but few are zero
    for (int lane = 0; words[word] != 0; ++lane, words[word] >>= 16)
      bits |= static_cast<uint32_t>(words[word] & 1) << (4 * word + lane);
  return bits;
#endif
}

} // namespace engram::ENGRAM_ISA
