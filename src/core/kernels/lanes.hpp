// Vectors of bytes, as wide as the instruction set has them. Whatever is computed with them is
// computed per byte, so the width changes the speed and never the result.
#pragma once

#include <cstdint>

#ifdef __SSE2__
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace engram::ENGRAM_ISA {

#if defined(__AVX512BW__)
constexpr int lanes = 64;
#elif defined(__AVX2__)
constexpr int lanes = 32;
#else
constexpr int lanes = 16;
#endif

typedef uint8_t Bytes __attribute__((vector_size(lanes)));
typedef uint16_t Words __attribute__((vector_size(lanes)));     // half as many, twice as wide
typedef uint8_t HalfBytes __attribute__((vector_size(lanes / 2)));

template <class Vector> inline Vector load(const void *from) {
  Vector vector;
  __builtin_memcpy(&vector, from, sizeof vector);
  return vector;
}

template <class Vector> inline void store(void *to, Vector vector) {
  __builtin_memcpy(to, &vector, sizeof vector);
}

inline Bytes smaller(Bytes a, Bytes b) { return a < b ? a : b; }
inline Bytes larger(Bytes a, Bytes b) { return a > b ? a : b; }
inline Bytes difference_or_zero(Bytes a, Bytes b) { return larger(a, b) - b; }
inline Bytes distance(Bytes a, Bytes b) { return larger(a, b) - smaller(a, b); }
inline Bytes all(uint8_t value) { return Bytes{} + value; }

// Bit k says whether byte k of a mask is set.
inline uint64_t bits_of(Bytes mask) {
#if defined(__AVX512BW__)
  return _mm512_movepi8_mask((__m512i)mask);
#elif defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_epi8((__m256i)mask));
#elif defined(__SSE2__)
  return static_cast<uint32_t>(_mm_movemask_epi8((__m128i)mask));
#else
  const Bytes bit = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
  const Bytes held = mask & bit;
#if defined(__aarch64__)
  return vaddv_u8(vget_low_u8((uint8x16_t)held)) |
         static_cast<uint64_t>(vaddv_u8(vget_high_u8((uint8x16_t)held))) << 8;
#else
  uint64_t bits = 0;
  for (int lane = 0; lane < lanes; ++lane)
    bits |= static_cast<uint64_t>(held[lane]) << (lane & 8);
  return bits;
#endif
#endif
}

} // namespace engram::ENGRAM_ISA
