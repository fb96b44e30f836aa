#include "kernels/sensor.hpp"

#include <math.h>

namespace engram::ENGRAM_ISA {
namespace {

// SplitMix64 (Steele et al. 2014): a counter-based generator, so that every pixel has its own noise
// whatever the order in which pixels are made.
inline uint64_t scramble(uint64_t x) {
  x += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

// The sum of four uniform numbers is normal enough for noise; its variance is made one.
inline float noise(uint64_t seed, uint64_t pixel) {
  const uint64_t bits = scramble(seed ^ (pixel * 0x2545f4914f6cdd1dull));
  const int32_t sum =
      static_cast<int32_t>(bits & 0xffff) + static_cast<int32_t>((bits >> 16) & 0xffff) +
      static_cast<int32_t>((bits >> 32) & 0xffff) + static_cast<int32_t>(bits >> 48);
  return (static_cast<float>(sum) - 131070.0f) * (1.7320508f / 65536.0f);
}

} // namespace

void develop(const float *luminance, int32_t width, int32_t height, const Sensor &sensor,
             uint8_t *grey) {
  const float scale_x = 2.0f / static_cast<float>(width),
              scale_y = 2.0f / static_cast<float>(height);
  for (int32_t y = 0; y < height; ++y)
    for (int32_t x = 0; x < width; ++x) {
      const int64_t i = static_cast<int64_t>(y) * width + x;
      const float a = static_cast<float>(x) * scale_x - 1, b = static_cast<float>(y) * scale_y - 1;
      const float exposed =
          luminance[i] * sensor.gain * (1 - 0.5f * sensor.vignette * (a * a + b * b));
      const float clipped = exposed < 1.5f ? exposed : 1.5f;
      const float sigma = sqrtf(sensor.shot * clipped + sensor.read * sensor.read);
      const float noisy = clipped + sigma * noise(sensor.seed, static_cast<uint64_t>(i));
      const float in_range = noisy < 0 ? 0 : noisy > 1 ? 1 : noisy;
      grey[i] = static_cast<uint8_t>(255 * sqrtf(in_range) + 0.5f);
    }
}

void smear(const float *luminance, const float *inverse_depths, int32_t width, int32_t height,
           float fx, float fy, float cx, float cy, const float *twist, float *smeared) {
  constexpr int kTaps = 7;
  for (int32_t y = 0; y < height; ++y)
    for (int32_t x = 0; x < width; ++x) {
      const int64_t i = static_cast<int64_t>(y) * width + x;
      const float a = (static_cast<float>(x) - cx) / fx, b = (static_cast<float>(y) - cy) / fy;
      const float w = inverse_depths[i];
      // Image motion of a point at inverse depth w (Longuet-Higgins and Prazdny 1980).
      const float du = fx * ((a * twist[2] - twist[0]) * w + a * b * twist[3] -
                             (1 + a * a) * twist[4] + b * twist[5]);
      const float dv = fy * ((b * twist[2] - twist[1]) * w + (1 + b * b) * twist[3] -
                             a * b * twist[4] - a * twist[5]);
      float sum = 0;
      for (int k = 0; k < kTaps; ++k) {
        const float s = static_cast<float>(k) * (1.0f / (kTaps - 1)) - 0.5f;
        float u = static_cast<float>(x) + s * du, v = static_cast<float>(y) + s * dv;
        u = u < 0 ? 0 : u > static_cast<float>(width - 1) ? static_cast<float>(width - 1) : u;
        v = v < 0 ? 0 : v > static_cast<float>(height - 1) ? static_cast<float>(height - 1) : v;
        const int32_t i0 = static_cast<int32_t>(u), j0 = static_cast<int32_t>(v);
        const int32_t i1 = i0 + 1 < width ? i0 + 1 : i0, j1 = j0 + 1 < height ? j0 + 1 : j0;
        const float p = u - static_cast<float>(i0), q = v - static_cast<float>(j0);
        const float *row0 = luminance + static_cast<int64_t>(j0) * width;
        const float *row1 = luminance + static_cast<int64_t>(j1) * width;
        sum +=
            (row0[i0] * (1 - p) + row0[i1] * p) * (1 - q) + (row1[i0] * (1 - p) + row1[i1] * p) * q;
      }
      smeared[i] = sum * (1.0f / kTaps);
    }
}

} // namespace engram::ENGRAM_ISA
