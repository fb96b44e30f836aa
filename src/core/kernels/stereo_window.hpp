// The 16×9 window of the fine stereo search in registers, 16 bits a pixel, and its exact sums.
#pragma once

#include <array>
#include <cstdint>
#include <cstring>

#ifdef __SSE2__
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#include "kernels/pack.hpp"

namespace engram::ENGRAM_ISA {

constexpr int fine_width = 16, fine_height = 9, fine_pixels = fine_width * fine_height;

typedef int16_t Pixels __attribute__((vector_size(kRegisterBytes)));
typedef int32_t Totals __attribute__((vector_size(kRegisterBytes)));

// Two rows, one or half a one to a register; the last of an odd number of rows is filled with 0.
constexpr int kPixelLanes = kRegisterBytes / 2;
constexpr int kWindowParts = (fine_pixels + kPixelLanes - 1) / kPixelLanes;

typedef std::array<Pixels, kWindowParts> FineWindow;

// Part `part` of the window whose upper left pixel is `at`.
ENGRAM_INLINE Pixels pixels_of(const uint8_t *at, int64_t stride, int part) {
#if defined(__AVX512BW__)
  const auto row = [&](int k) {
    return _mm_loadu_si128(reinterpret_cast<const __m128i *>(at + k * stride));
  };
  const __m128i first = row(2 * part);
  return (Pixels)_mm512_cvtepu8_epi16(
      2 * part + 1 < fine_height
          ? _mm256_inserti128_si256(_mm256_castsi128_si256(first), row(2 * part + 1), 1)
          : _mm256_zextsi128_si256(first));
#elif defined(__AVX2__)
  return (Pixels)_mm256_cvtepu8_epi16(
      _mm_loadu_si128(reinterpret_cast<const __m128i *>(at + part * stride)));
#else
  typedef uint8_t Eight __attribute__((vector_size(8)));
  Eight eight;
  std::memcpy(&eight, at + part / 2 * stride + 8 * (part % 2), sizeof eight);
#if defined(__SSE2__)
  int64_t bits;
  std::memcpy(&bits, &eight, sizeof bits);
  return (Pixels)_mm_unpacklo_epi8(_mm_cvtsi64_si128(bits), _mm_setzero_si128());
#else
  return __builtin_convertvector(eight, Pixels);
#endif
#endif
}

// totals + a · b, neighbours added to one total.
ENGRAM_INLINE Totals plus_products(Totals totals, Pixels a, Pixels b) {
#if defined(__AVX512BW__)
  return totals + (Totals)_mm512_madd_epi16((__m512i)a, (__m512i)b);
#elif defined(__AVX2__)
  return totals + (Totals)_mm256_madd_epi16((__m256i)a, (__m256i)b);
#elif defined(__SSE2__)
  return totals + (Totals)_mm_madd_epi16((__m128i)a, (__m128i)b);
#elif defined(__aarch64__)
  const int32x4_t low = vmlal_s16((int32x4_t)totals, vget_low_s16((int16x8_t)a),
                                  vget_low_s16((int16x8_t)b));
  return (Totals)vmlal_high_s16(low, (int16x8_t)a, (int16x8_t)b);
#else
  for (int lane = 0; lane < kPixelLanes; ++lane)
    totals[lane / 2] += a[lane] * b[lane];
  return totals;
#endif
}

ENGRAM_INLINE int32_t total_of(Totals totals) {
#if defined(__AVX512BW__)
  const auto eight = __builtin_shufflevector(totals, totals, 0, 1, 2, 3, 4, 5, 6, 7) +
                     __builtin_shufflevector(totals, totals, 8, 9, 10, 11, 12, 13, 14, 15);
#else
  const auto eight = totals;
#endif
#if defined(__AVX2__)
  const auto four = __builtin_shufflevector(eight, eight, 0, 1, 2, 3) +
                    __builtin_shufflevector(eight, eight, 4, 5, 6, 7);
#else
  const auto four = eight;
#endif
  const auto two = four + __builtin_shufflevector(four, four, 2, 3, 0, 1);
  return two[0] + two[1];
}

// Sum of absolute differences of two windows.
ENGRAM_INLINE int sum_of_differences(const uint8_t *left, int64_t stride, const uint8_t *right,
                                     int64_t right_stride) {
#if defined(__SSE2__)
  __m128i sum = _mm_setzero_si128();
  for (int row = 0; row < fine_height; ++row, left += stride, right += right_stride)
    sum = _mm_add_epi32(sum,
                        _mm_sad_epu8(_mm_loadu_si128(reinterpret_cast<const __m128i *>(left)),
                                     _mm_loadu_si128(reinterpret_cast<const __m128i *>(right))));
  return _mm_cvtsi128_si32(sum) + _mm_cvtsi128_si32(_mm_srli_si128(sum, 8));
#elif defined(__aarch64__)
  uint16x8_t sum = vdupq_n_u16(0);
  for (int row = 0; row < fine_height; ++row, left += stride, right += right_stride)
    sum = vpadalq_u8(sum, vabdq_u8(vld1q_u8(left), vld1q_u8(right)));
  return static_cast<int>(vaddlvq_u16(sum));
#else
  int sum = 0;
  for (int row = 0; row < fine_height; ++row, left += stride, right += right_stride)
    for (int column = 0; column < fine_width; ++column)
      sum += left[column] < right[column] ? right[column] - left[column]
                                          : left[column] - right[column];
  return sum;
#endif
}

} // namespace engram::ENGRAM_ISA
