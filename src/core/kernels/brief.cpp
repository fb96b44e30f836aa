#include "kernels/brief.hpp"

#include "kernels/lanes.hpp"

#ifdef __AVX512BW__
#include <immintrin.h>
#endif

namespace engram::ENGRAM_ISA {
namespace {

constexpr int tests = 256;
constexpr int8_t pattern[tests][4] = {
#include "kernels/brief_pattern.inc"
};

// One bit of each of eight bytes that are 0 or 255, the first byte's lowest.
inline uint64_t gather_bits(uint64_t bytes) {
  return ((bytes & 0x8040201008040201) * 0x0101010101010101) >> 56;
}

#ifdef __AVX512BW__
// The 31 rows of 32 bytes of a patch in sixteen registers, two rows to each: what a test reads is
// byte 32 · row + column. Each pair of registers is looked up by one instruction, and the one that
// holds the byte is kept.
struct Places {
  alignas(64) uint8_t byte[2][tests]; // the low seven bits: which of a pair's 128
  uint64_t in_pair[2][tests / 64][8]; // tests that read this pair

  Places() : byte{}, in_pair{} {
    for (int t = 0; t < tests; ++t)
      for (int end = 0; end < 2; ++end) {
        const int at = 32 * (pattern[t][2 * end + 1] + 15) + pattern[t][2 * end] + 15;
        byte[end][t] = static_cast<uint8_t>(at % 128);
        in_pair[end][t / 64][at / 128] |= uint64_t{1} << (t % 64);
      }
  }
};

__attribute__((target("avx512vbmi"))) void describe_in_registers(const Image &smoothed,
                                                                 const Corner *corners,
                                                                 int64_t count,
                                                                 uint64_t *descriptors) {
  static const Places places;
  for (int64_t i = 0; i < count; ++i) {
    const uint8_t *patch =
        smoothed.pixels + (corners[i].y - 15) * smoothed.width + corners[i].x - 15;
    __m512i rows[16];
    for (int k = 0; k < 16; ++k) {
      const auto *upper = patch + 2 * k * smoothed.width;
      const auto *lower = k < 15 ? upper + smoothed.width : upper;
      rows[k] = _mm512_inserti64x4(
          _mm512_zextsi256_si512(_mm256_loadu_si256(reinterpret_cast<const __m256i *>(upper))),
          _mm256_loadu_si256(reinterpret_cast<const __m256i *>(lower)), 1);
    }
    for (int word = 0; word < tests / 64; ++word) {
      __m512i read[2];
      for (int end = 0; end < 2; ++end) {
        const __m512i byte = _mm512_load_si512(places.byte[end] + 64 * word);
        const uint64_t *in_pair = places.in_pair[end][word];
        read[end] = _mm512_maskz_permutex2var_epi8(in_pair[0], rows[0], byte, rows[1]);
        for (int k = 1; k < 8; ++k)
          read[end] = _mm512_or_si512(
              read[end],
              _mm512_maskz_permutex2var_epi8(in_pair[k], rows[2 * k], byte, rows[2 * k + 1]));
      }
      descriptors[4 * i + word] = _mm512_cmplt_epu8_mask(read[0], read[1]);
    }
  }
}
#endif

} // namespace

void describe(const Image &smoothed, const Corner *corners, int64_t count, uint64_t *descriptors) {
#ifdef __AVX512BW__
  static const bool has_vbmi = __builtin_cpu_supports("avx512vbmi");
  if (has_vbmi)
    return describe_in_registers(smoothed, corners, count, descriptors);
#endif
  int32_t first_at[tests], second_at[tests];
  for (int t = 0; t < tests; ++t) {
    first_at[t] = static_cast<int32_t>(pattern[t][1] * smoothed.width + pattern[t][0]);
    second_at[t] = static_cast<int32_t>(pattern[t][3] * smoothed.width + pattern[t][2]);
  }
  for (int64_t i = 0; i < count; ++i) {
    const uint8_t *centre = smoothed.pixels + corners[i].y * smoothed.width + corners[i].x;
    uint8_t first[tests], second[tests];
    for (int t = 0; t < tests; ++t) {
      first[t] = centre[first_at[t]];
      second[t] = centre[second_at[t]];
    }
    uint64_t darker[tests / 8];
    for (int t = 0; t < tests; t += lanes)
      store(darker + t / 8, (Bytes)(load<Bytes>(first + t) < load<Bytes>(second + t)));
    for (int word = 0; word < 4; ++word) {
      uint64_t bits = 0;
      for (int part = 0; part < 8; ++part)
        bits |= gather_bits(darker[8 * word + part]) << (8 * part);
      descriptors[4 * i + word] = bits;
    }
  }
}

} // namespace engram::ENGRAM_ISA
