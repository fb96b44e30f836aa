// Vectors of sixteen floats or integers. Every instruction set sums in the same order, lane by lane
// and then the lanes in halves, so that all of them give the same bits.
#pragma once

#include <array>
#include <cstdint>
#include <cstring>

#ifdef __SSE2__
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#include "kernels/pack.hpp"

namespace engram::ENGRAM_ISA {

constexpr int64_t kLanes = 16;

typedef Pack<float, 16> Floats;
typedef Pack<int32_t, 16> Ints;
typedef Pack<int16_t, 32> Shorts;

inline Floats load(const float *values) { return Floats::load(values); }
inline Ints load(const int32_t *values) { return Ints::load(values); }
inline Shorts load(const int16_t *values) { return Shorts::load(values); }

typedef float FourFloats __attribute__((vector_size(16)));

// Lanes 0, 4, 8, 12 summed, and so on: in halves, lane 0 with lane 8, then with lane 4.
ENGRAM_INLINE FourFloats sum_to_four(const Floats &lanes) {
#if defined(__AVX512BW__)
  const auto &all = lanes.part[0];
  const auto eight = __builtin_shufflevector(all, all, 0, 1, 2, 3, 4, 5, 6, 7) +
                     __builtin_shufflevector(all, all, 8, 9, 10, 11, 12, 13, 14, 15);
#elif defined(__AVX2__)
  const auto eight = lanes.part[0] + lanes.part[1];
#else
  return (lanes.part[0] + lanes.part[2]) + (lanes.part[1] + lanes.part[3]);
#endif
#if defined(__AVX2__)
  return __builtin_shufflevector(eight, eight, 0, 1, 2, 3) +
         __builtin_shufflevector(eight, eight, 4, 5, 6, 7);
#endif
}

// Of sixteen lanes of which all but these are zero.
ENGRAM_INLINE FourFloats sum_to_four(const Pack<float, 4> &lanes) { return lanes.part[0]; }

inline float sum(const Floats &lanes) {
  const FourFloats four = sum_to_four(lanes);
  return (four[0] + four[2]) + (four[1] + four[3]);
}

// The sums of four vectors, each in the order of sum().
template <class Lanes>
ENGRAM_INLINE FourFloats sums(const Lanes &a, const Lanes &b, const Lanes &c, const Lanes &d) {
  const FourFloats fa = sum_to_four(a), fb = sum_to_four(b), fc = sum_to_four(c),
                   fd = sum_to_four(d);
  const FourFloats ab = __builtin_shufflevector(fa, fb, 0, 4, 1, 5) +
                        __builtin_shufflevector(fa, fb, 2, 6, 3, 7);
  const FourFloats cd = __builtin_shufflevector(fc, fd, 0, 4, 1, 5) +
                        __builtin_shufflevector(fc, fd, 2, 6, 3, 7);
  return __builtin_shufflevector(ab, cd, 0, 1, 4, 5) + __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
}

inline int32_t sum(const Ints &lanes) {
  const auto four = (quarter_of<0>(lanes) + quarter_of<2>(lanes)) +
                    (quarter_of<1>(lanes) + quarter_of<3>(lanes));
  return (four[0] + four[2]) + (four[1] + four[3]);
}

template <int lanes> using Vec3Floats = std::array<Pack<float, lanes>, 3>;

template <int lanes>
ENGRAM_INLINE Vec3Floats<lanes> cross(const Vec3Floats<lanes> &a, const Vec3Floats<lanes> &b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// Bit k says whether lane k of a mask holds.
inline uint32_t bits_of(const Ints &mask) {
#if defined(__AVX512BW__)
  return _mm512_movepi32_mask((__m512i)mask.part[0]);
#elif defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_ps((__m256)mask.part[0])) |
         static_cast<uint32_t>(_mm256_movemask_ps((__m256)mask.part[1])) << 8;
#elif defined(__SSE2__)
  uint32_t bits = 0;
  for (int k = 0; k < 4; ++k)
    bits |= static_cast<uint32_t>(_mm_movemask_ps((__m128)mask.part[k])) << (4 * k);
  return bits;
#else
  uint32_t bits = 0;
  for (int k = 0; k < 4; ++k) {
    const auto held = mask.part[k] & Ints::Part{1, 2, 4, 8};
#if defined(__aarch64__)
    bits |= static_cast<uint32_t>(vaddvq_s32((int32x4_t)held)) << (4 * k);
#else
    bits |= static_cast<uint32_t>(held[0] | held[1] | held[2] | held[3]) << (4 * k);
#endif
  }
  return bits;
#endif
}

inline uint32_t bits_of(const Shorts &mask) {
#if defined(__AVX512BW__)
  return _mm512_movepi16_mask((__m512i)mask.part[0]);
#elif defined(__AVX2__)
  // Packing takes the quarters in the order 0 2 1 3.
  const __m256i bytes = _mm256_permute4x64_epi64(
      _mm256_packs_epi16((__m256i)mask.part[0], (__m256i)mask.part[1]), 0xd8);
  return static_cast<uint32_t>(_mm256_movemask_epi8(bytes));
#elif defined(__SSE2__)
  const auto pair = [&](int k) {
    return static_cast<uint32_t>(
        _mm_movemask_epi8(_mm_packs_epi16((__m128i)mask.part[k], (__m128i)mask.part[k + 1])));
  };
  return pair(0) | pair(2) << 16;
#else
  uint32_t bits = 0;
  for (int k = 0; k < 4; ++k) {
    const auto held = mask.part[k] & Shorts::Part{1, 2, 4, 8, 16, 32, 64, 128};
#if defined(__aarch64__)
    bits |= static_cast<uint32_t>(vaddvq_s16((int16x8_t)held)) << (8 * k);
#else
    for (int lane = 0; lane < 8; ++lane)
      bits |= static_cast<uint32_t>(held[lane]) << (8 * k);
#endif
  }
  return bits;
#endif
}

} // namespace engram::ENGRAM_ISA
