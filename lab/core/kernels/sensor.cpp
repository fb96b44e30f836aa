#include "kernels/sensor.hpp"

#include <math.h>

#include <algorithm>

#include "kernels/pixel_lanes.hpp"

namespace engram::ENGRAM_ISA {
namespace {

using namespace wide;

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

struct Picture {
  const float *values;
  int32_t width, height;
};

// Means of seven places along each lane's way (du, dv), which has its middle at (column, row).
Floats mean_along(const Picture &picture, Floats column, float row, Floats du, Floats dv) {
  constexpr int kTaps = 7;
  const Floats right = all(static_cast<float>(picture.width - 1)),
               bottom = all(static_cast<float>(picture.height - 1));
  Floats sum = {};
  for (int k = 0; k < kTaps; ++k) {
    const float s = static_cast<float>(k) * (1.0f / (kTaps - 1)) - 0.5f;
    const Floats u = smaller(larger(column + s * du, Floats{}), right);
    const Floats v = smaller(larger(row + s * dv, Floats{}), bottom);
    const Floats i = smaller(floor_of(u), right - 1), j = smaller(floor_of(v), bottom - 1);
    const Floats p = u - i, q = v - j;
    const Addresses at =
        addresses_of(picture.values, truncated(j) * picture.width + truncated(i));
    const Pairs above = load_pairs(at), below = load_pairs(at + int64_t{4} * picture.width);
    sum += (as_floats(above.left) * (1 - p) + as_floats(above.right) * p) * (1 - q) +
           (as_floats(below.left) * (1 - p) + as_floats(below.right) * p) * q;
  }
  return sum * (1.0f / kTaps);
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
  if (width < kWide || height < 2) { // too small to move in
    std::copy_n(luminance, static_cast<int64_t>(width) * height, smeared);
    return;
  }
  const Picture picture = {luminance, width, height};
  Floats steps;
  for (int lane = 0; lane < kWide; ++lane)
    steps[lane] = static_cast<float>(lane);
  for (int32_t y = 0; y < height; ++y)
    for (int32_t x = 0; x < width; x += kWide) {
      x = x + kWide > width ? width - kWide : x; // the last lanes of a row may be done twice
      const int64_t i = static_cast<int64_t>(y) * width + x;
      const Floats column = static_cast<float>(x) + steps, w = load(inverse_depths + i);
      const Floats a = (column - cx) / fx;
      const float row = static_cast<float>(y), b = (row - cy) / fy;
      // Image motion of a point at inverse depth w (Longuet-Higgins and Prazdny 1980).
      const Floats du = fx * ((a * twist[2] - twist[0]) * w + a * b * twist[3] -
                              (1 + a * a) * twist[4] + b * twist[5]);
      const Floats dv = fy * ((b * twist[2] - twist[1]) * w + (1 + b * b) * twist[3] -
                              a * b * twist[4] - a * twist[5]);
      store(smeared + i, mean_along(picture, column, row, du, dv));
    }
}

} // namespace engram::ENGRAM_ISA
