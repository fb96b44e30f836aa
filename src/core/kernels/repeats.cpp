#include "kernels/repeats.hpp"

#include <algorithm>

namespace engram::ENGRAM_ISA {

EqualPixels equal_pixels(const Image &now, const Image &before, uint8_t black, uint8_t white) {
  constexpr int64_t kBlock = 255; // of counts in a byte
  const int64_t count = now.width * now.height;
  EqualPixels found{0, 0};
  for (int64_t from = 0; from < count; from += kBlock) {
    const int64_t to = std::min(from + kBlock, count);
    uint8_t telling = 0, equal = 0;
    for (int64_t i = from; i < to; ++i) {
      const uint8_t tells = (now.pixels[i] > black) & (now.pixels[i] < white);
      telling = static_cast<uint8_t>(telling + tells);
      equal = static_cast<uint8_t>(equal + (tells & (now.pixels[i] == before.pixels[i])));
    }
    found.telling += telling;
    found.equal += equal;
  }
  return found;
}

} // namespace engram::ENGRAM_ISA
