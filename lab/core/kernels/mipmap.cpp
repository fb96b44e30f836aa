#include "kernels/mipmap.hpp"

namespace engram::ENGRAM_ISA {

void halve_texture(const uint8_t *from, int32_t width, int32_t height, bool keep_coverage,
                   uint8_t *to) {
  const int32_t half_width = width > 1 ? width / 2 : 1, half_height = height > 1 ? height / 2 : 1;
  int64_t covered = 0;
  for (int64_t i = 0; i < static_cast<int64_t>(width) * height; ++i)
    covered += from[4 * i + 3] >= 128;
  int32_t histogram[256] = {};
  for (int32_t y = 0; y < half_height; ++y)
    for (int32_t x = 0; x < half_width; ++x) {
      // Sizes need not be even: each texel averages the span that it covers.
      const int32_t x0 = x * width / half_width, x1 = (x + 1) * width / half_width;
      const int32_t y0 = y * height / half_height, y1 = (y + 1) * height / half_height;
      int32_t sum[4] = {};
      for (int32_t j = y0; j < y1; ++j)
        for (int32_t i = x0; i < x1; ++i)
          for (int c = 0; c < 4; ++c)
            sum[c] += from[4 * (static_cast<int64_t>(j) * width + i) + c];
      const int32_t count = (x1 - x0) * (y1 - y0);
      uint8_t *texel = to + 4 * (static_cast<int64_t>(y) * half_width + x);
      for (int c = 0; c < 4; ++c)
        texel[c] = static_cast<uint8_t>((sum[c] + count / 2) / count);
      ++histogram[texel[3]];
    }
  if (!keep_coverage)
    return;
  // The threshold above which the same share as before is covered becomes 128.
  const int64_t texels = static_cast<int64_t>(half_width) * half_height;
  const int64_t wanted = covered * texels / (static_cast<int64_t>(width) * height);
  int32_t threshold = 255;
  for (int64_t above = histogram[255]; threshold > 1 && above < wanted;)
    above += histogram[--threshold];
  for (int64_t i = 0; i < texels; ++i) {
    const int32_t stretched = to[4 * i + 3] * 128 / threshold;
    to[4 * i + 3] = static_cast<uint8_t>(stretched > 255 ? 255 : stretched);
  }
}

} // namespace engram::ENGRAM_ISA
