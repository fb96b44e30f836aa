#include "kernels/pyramid.hpp"

#include "kernels/buffer.hpp"
#include "kernels/lanes.hpp"

namespace engram::ENGRAM_ISA {

void smooth(const Image &image, uint8_t *smoothed) {
  const int64_t width = image.width;
  static thread_local Buffer<uint16_t> scratch;
  uint16_t *column = scratch.room_for(width);
  for (int64_t y = 2; y < image.height - 2; ++y) {
    const uint8_t *row = image.pixels + y * width;
    for (int64_t x = 0; x < width; ++x)
      column[x] = static_cast<uint16_t>(row[x - 2 * width] + row[x + 2 * width] +
                                        4 * (row[x - width] + row[x + width]) + 6 * row[x]);
    uint8_t *out = smoothed + y * width;
    // 256·255 + 128 still fits 16 bits: the sums stay in the narrow type.
    for (int64_t x = 2; x < width - 2; ++x) {
      const auto outer = static_cast<uint16_t>(column[x - 2] + column[x + 2]);
      const auto inner = static_cast<uint16_t>(4 * (column[x - 1] + column[x + 1]));
      const auto sum = static_cast<uint16_t>(outer + inner + 6 * column[x] + 128);
      out[x] = static_cast<uint8_t>(sum >> 8);
    }
  }
}

void halve(const Image &image, uint8_t *half) {
  constexpr int64_t step = lanes / 2; // pixels written at once
  const int64_t width = image.width / 2, height = image.height / 2;
  for (int64_t y = 0; y < height; ++y) {
    const uint8_t *upper = image.pixels + 2 * y * image.width;
    const uint8_t *lower = upper + image.width;
    uint8_t *out = half + y * width;
    int64_t x = 0;
    for (; x + step <= width; x += step) {
      const auto a = load<Words>(upper + 2 * x), b = load<Words>(lower + 2 * x);
      const Words sum = (a & 255) + (a >> 8) + (b & 255) + (b >> 8) + 2;
      store(out + x, __builtin_convertvector(sum >> 2, HalfBytes));
    }
    for (; x < width; ++x)
      out[x] = static_cast<uint8_t>(
          (upper[2 * x] + upper[2 * x + 1] + lower[2 * x] + lower[2 * x + 1] + 2) >> 2);
  }
}

} // namespace engram::ENGRAM_ISA
