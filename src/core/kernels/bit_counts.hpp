// Counts of set bits in vectors of 64-bit words.
#pragma once

#include <cstdint>

#ifdef __SSE2__
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#include "kernels/pack.hpp"

namespace engram::ENGRAM_ISA {

typedef Pack<uint64_t, 8> Counts;

// The bits of each word, counted where the processor counts best: in its bytes (a byte has room for
// those of 31 words), or in the word at once.
ENGRAM_INLINE Counts bits_within(const Counts &words) {
  Counts result;
  for (int k = 0; k < Counts::kParts; ++k) {
#if defined(__AVX512VPOPCNTDQ__)
    result.part[k] = (Counts::Part)_mm512_popcnt_epi64((__m512i)words.part[k]);
#elif defined(__AVX2__)
    const __m256i of_nibble =
        _mm256_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3, 1,
                         2, 2, 3, 2, 3, 3, 4);
    const __m256i low = _mm256_set1_epi8(15), here = (__m256i)words.part[k];
    const __m256i above = _mm256_and_si256(_mm256_srli_epi16(here, 4), low);
    result.part[k] = (Counts::Part)_mm256_add_epi8(
        _mm256_shuffle_epi8(of_nibble, _mm256_and_si256(here, low)),
        _mm256_shuffle_epi8(of_nibble, above));
#elif defined(__aarch64__)
    result.part[k] = (Counts::Part)vcntq_u8((uint8x16_t)words.part[k]);
#else
    auto x = words.part[k];
    x -= (x >> 1) & 0x5555555555555555;
    x = (x & 0x3333333333333333) + ((x >> 2) & 0x3333333333333333);
    result.part[k] = (x + (x >> 4)) & 0x0f0f0f0f0f0f0f0f;
#endif
  }
  return result;
}

// Sums of bits_within(), of at most 31 words, as one number a word.
ENGRAM_INLINE Counts totals_of(const Counts &within) {
#if defined(__AVX512VPOPCNTDQ__)
  return within;
#else
  Counts result;
  for (int k = 0; k < Counts::kParts; ++k) {
#if defined(__AVX2__)
    result.part[k] =
        (Counts::Part)_mm256_sad_epu8((__m256i)within.part[k], _mm256_setzero_si256());
#elif defined(__SSE2__)
    result.part[k] = (Counts::Part)_mm_sad_epu8((__m128i)within.part[k], _mm_setzero_si128());
#elif defined(__aarch64__)
    result.part[k] =
        (Counts::Part)vpaddlq_u32(vpaddlq_u16(vpaddlq_u8((uint8x16_t)within.part[k])));
#else
    auto x = (within.part[k] & 0x00ff00ff00ff00ff) + ((within.part[k] >> 8) & 0x00ff00ff00ff00ff);
    x += x >> 16;
    result.part[k] = (x + (x >> 32)) & 0xffff;
#endif
  }
  return result;
#endif
}

ENGRAM_INLINE Counts popcount(const Counts &words) { return totals_of(bits_within(words)); }

// Bits in which a descriptor differs from each of eight others; word w of theirs lies at
// columns + w · stride.
template <class Width>
ENGRAM_INLINE Counts differing_bits(const uint64_t *descriptor, const uint64_t *columns,
                                    int64_t stride, Width width) {
  constexpr int kMost = 31;
  Counts total(0);
  for (int first = 0; first < width; first += kMost) {
    Counts within(0);
    for (int word = first; word < width && word < first + kMost; ++word)
      within += bits_within(Counts::load(columns + word * stride) ^ Counts(descriptor[word]));
    total += totals_of(within);
  }
  return total;
}

} // namespace engram::ENGRAM_ISA
