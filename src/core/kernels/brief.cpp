#include "kernels/brief.hpp"

#include "kernels/lanes.hpp"

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

} // namespace

void describe(const Image &smoothed, const Corner *corners, int64_t count, uint64_t *descriptors) {
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
