// Vectors with one pixel to a lane, as wide as the instruction set has them. Lanes never meet, so
// the width changes the speed and never the result.
#pragma once

#include <cstdint>
#include <cstring>
#include <math.h>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace engram::ENGRAM_ISA::wide {

#if defined(__AVX512BW__)
constexpr int kWide = 16;
#elif defined(__AVX2__)
constexpr int kWide = 8;
#else
constexpr int kWide = 4;
#endif

typedef float Floats __attribute__((vector_size(4 * kWide)));
typedef int32_t Ints __attribute__((vector_size(4 * kWide)));
typedef uint32_t Words __attribute__((vector_size(4 * kWide)));
typedef int64_t Addresses __attribute__((vector_size(8 * kWide)));

inline Floats all(float value) { return value - Floats{}; }
inline Ints all(int32_t value) { return value - Ints{}; }
inline Floats load(const float *values) {
  Floats lanes;
  std::memcpy(&lanes, values, sizeof lanes);
  return lanes;
}
inline void store(float *values, Floats lanes) { std::memcpy(values, &lanes, sizeof lanes); }
inline void store(int32_t *values, Ints lanes) { std::memcpy(values, &lanes, sizeof lanes); }

inline Ints as_ints(Floats lanes) { return reinterpret_cast<Ints>(lanes); }
inline Floats as_floats(Ints lanes) { return reinterpret_cast<Floats>(lanes); }
inline Ints truncated(Floats lanes) { return __builtin_convertvector(lanes, Ints); }
inline Floats to_floats(Ints lanes) { return __builtin_convertvector(lanes, Floats); }

inline Floats smaller(Floats a, Floats b) { return a < b ? a : b; }
inline Floats larger(Floats a, Floats b) { return a > b ? a : b; }
inline Floats clamp01(Floats x) { return smaller(larger(x, Floats{}), all(1.0f)); }
inline Floats magnitude(Floats x) { return as_floats(as_ints(x) & 0x7fffffff); }
inline Floats where(Ints mask, Floats value) { return as_floats(mask & as_ints(value)); }

// Bit k says whether lane k of a comparison holds.
inline uint32_t bits_of(Ints mask) {
#if defined(__AVX512BW__)
  return _mm512_movepi32_mask(reinterpret_cast<__m512i>(mask));
#elif defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(mask)));
#elif defined(__x86_64__)
  return static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(mask)));
#else
  uint32_t bits = 0;
  for (int lane = 0; lane < kWide; ++lane)
    bits |= static_cast<uint32_t>(mask[lane] & 1) << lane;
  return bits;
#endif
}
inline bool any(Ints mask) { return bits_of(mask) != 0; }

inline Floats root(Floats x) {
#if defined(__AVX512BW__)
  return reinterpret_cast<Floats>(_mm512_maskz_sqrt_ps(0xffff, reinterpret_cast<__m512>(x)));
#elif defined(__AVX2__)
  return reinterpret_cast<Floats>(_mm256_sqrt_ps(reinterpret_cast<__m256>(x)));
#elif defined(__x86_64__)
  return reinterpret_cast<Floats>(_mm_sqrt_ps(reinterpret_cast<__m128>(x)));
#else
  for (int lane = 0; lane < kWide; ++lane)
    x[lane] = sqrtf(x[lane]);
  return x;
#endif
}

// Of numbers below 2³¹.
inline Floats floor_of(Floats x) {
#if defined(__AVX512BW__)
  return reinterpret_cast<Floats>(_mm512_maskz_roundscale_ps(0xffff, reinterpret_cast<__m512>(x), 0x09));
#elif defined(__AVX2__)
  return reinterpret_cast<Floats>(_mm256_floor_ps(reinterpret_cast<__m256>(x)));
#else
  const Floats whole = to_floats(truncated(x));
  return whole - where(whole > x, all(1.0f));
#endif
}

// Two neighbouring 32-bit words from one address a lane.
struct Pairs {
  Ints left, right;
};

inline Ints load_words(const int64_t *addresses) { // two from each of half as many addresses
  typedef int64_t Both __attribute__((vector_size(4 * kWide)));
  Both words = {};
  for (int lane = 0; lane < kWide / 2; ++lane) {
    int64_t both;
    std::memcpy(&both, reinterpret_cast<const void *>(addresses[lane]), 8);
    words[lane] = both;
  }
  return reinterpret_cast<Ints>(words);
}

inline Pairs load_pairs(Addresses addresses) {
  int64_t at[kWide];
  std::memcpy(at, &addresses, sizeof at);
  const Ints first = load_words(at), second = load_words(at + kWide / 2);
#if defined(__AVX512BW__)
  return {__builtin_shufflevector(first, second, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26,
                                  28, 30),
          __builtin_shufflevector(first, second, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27,
                                  29, 31)};
#elif defined(__AVX2__)
  return {__builtin_shufflevector(first, second, 0, 2, 4, 6, 8, 10, 12, 14),
          __builtin_shufflevector(first, second, 1, 3, 5, 7, 9, 11, 13, 15)};
#else
  return {__builtin_shufflevector(first, second, 0, 2, 4, 6),
          __builtin_shufflevector(first, second, 1, 3, 5, 7)};
#endif
}

inline Addresses widened(Ints lanes) { return __builtin_convertvector(lanes, Addresses); }
inline Addresses all_addresses(const void *base) {
  return reinterpret_cast<int64_t>(base) - Addresses{};
}
template <class Value> inline Addresses addresses_of(const Value *base, Ints index) {
  return all_addresses(base) + widened(index) * static_cast<int64_t>(sizeof(Value));
}

// base[index] of each lane.
inline Ints gather(const int32_t *base, Ints index) {
#if defined(__AVX512BW__)
  return reinterpret_cast<Ints>(_mm512_mask_i32gather_epi32(
      _mm512_setzero_si512(), 0xffff, reinterpret_cast<__m512i>(index), base, 4));
#elif defined(__AVX2__)
  return reinterpret_cast<Ints>(
      _mm256_i32gather_epi32(base, reinterpret_cast<__m256i>(index), 4));
#else
  Ints values;
  for (int lane = 0; lane < kWide; ++lane)
    values[lane] = base[index[lane]];
  return values;
#endif
}

inline Addresses gather(const int64_t *base, Ints index) {
  Addresses values;
  int32_t at[kWide];
  store(at, index);
  for (int lane = 0; lane < kWide; ++lane)
    values[lane] = base[at[lane]];
  return values;
}

struct Vec {
  Floats x, y, z;
};
inline Vec operator+(const Vec &a, const Vec &b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(const Vec &a, const Vec &b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(Floats s, const Vec &a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec operator*(float s, const Vec &a) { return {s * a.x, s * a.y, s * a.z}; }
inline Floats dot(const Vec &a, const Vec &b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec everywhere(const float *p) { return {all(p[0]), all(p[1]), all(p[2])}; }

inline Floats mix(Floats a, Floats b, Floats s) { return a + (b - a) * s; }
inline Floats smooth(Floats low, Floats high, Floats x) {
  const Floats s = clamp01((x - low) / (high - low));
  return s * s * (3 - 2 * s);
}
inline Floats smooth(float low, float high, Floats x) { return smooth(all(low), all(high), x); }

// 2^x within 2e-6, the same bits on every machine: no library function.
inline Floats exp2_of(Floats x) {
  x = smaller(larger(x, all(-100.0f)), all(100.0f));
  const Floats whole = floor_of(x), f = x - whole;
  const Floats power =
      1 + f * (0.69314718f +
               f * (0.24022651f + f * (0.05550411f + f * (0.00961813f + f * 0.00133336f))));
  return power * as_floats((truncated(whole) + 127) << 23);
}
inline Floats exp_of(Floats x) { return exp2_of(1.44269504f * x); }

// log2 within 0.01, which is plenty for a mip level.
inline Floats log2_of(Floats x) {
  const Ints bits = as_ints(x);
  const Floats exponent = to_floats((bits >> 23) - 127);
  const Floats m = as_floats((bits & 0x7fffff) | 0x3f800000);
  return exponent + (m - 1) * (1.3465f - 0.3465f * m);
}

inline Floats power8(Floats x) {
  x *= x;
  x *= x;
  return x * x;
}

// The kWide × kWide block of rows turned into columns.
inline void transpose(Floats *rows) {
  for (int stage = 1; stage < kWide; stage *= 2) {
    Floats turned[kWide];
    for (int i = 0; i < kWide / 2; ++i) {
      const Floats a = rows[i], b = rows[i + kWide / 2];
#if defined(__AVX512BW__)
      turned[2 * i] =
          __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
      turned[2 * i + 1] = __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13,
                                                  29, 14, 30, 15, 31);
#elif defined(__AVX2__)
      turned[2 * i] = __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11);
      turned[2 * i + 1] = __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15);
#else
      turned[2 * i] = __builtin_shufflevector(a, b, 0, 4, 1, 5);
      turned[2 * i + 1] = __builtin_shufflevector(a, b, 2, 6, 3, 7);
#endif
    }
    std::memcpy(rows, turned, sizeof turned);
  }
}

} // namespace engram::ENGRAM_ISA::wide
