// Vectors of bytes, as wide as the instruction set has them. Whatever is computed with them is
// computed per byte, so the width changes the speed and never the result.
#pragma once

#include <cstdint>

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

} // namespace engram::ENGRAM_ISA
