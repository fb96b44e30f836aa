#include "kernels/disparity.hpp"

#include <algorithm>
#include <cmath>

#include "kernels/lanes.hpp"

namespace engram::ENGRAM_ISA {
namespace {

constexpr int coarse_radius = 3;
constexpr int coarse_side = 2 * coarse_radius + 1;
// Differences count up to this: occlusions and highlights cannot outvote the rest, and the sum over
// a row of the window fits a byte.
constexpr uint8_t coarse_cap = 255 / coarse_side;
constexpr int most_candidates = 256;
constexpr uint16_t impossible = 0xffff;

// costs[k] = truncated SAD between the window whose upper left pixel is `window`, and that at
// `searched` + k, for k in [0, count); garbage up to the next multiple of `lanes`.
void scan_row(const uint8_t *window, const uint8_t *searched, int64_t stride, int count,
              uint16_t *costs) {
  for (int k = 0; k < count; k += lanes) {
    Words even{}, odd{};
    for (int row = 0; row < coarse_side; ++row) {
      Bytes sum{};
      for (int column = 0; column < coarse_side; ++column) {
        const Bytes there = load<Bytes>(searched + row * stride + column + k);
        sum += smaller(distance(all(window[row * stride + column]), there), all(coarse_cap));
      }
      even += (Words)sum & 255;
      odd += (Words)sum >> 8;
    }
    uint16_t evens[lanes / 2], odds[lanes / 2];
    store(evens, even);
    store(odds, odd);
    for (int pair = 0; pair < lanes / 2; ++pair) {
      costs[k + 2 * pair] = evens[pair];
      costs[k + 2 * pair + 1] = odds[pair];
    }
  }
}

uint16_t least(const uint16_t *costs, int count) {
  uint16_t best = impossible;
  for (int k = 0; k < count; ++k)
    best = costs[k] < best ? costs[k] : best;
  return best;
}

// The whole disparity at half resolution, or -1.
int search_half(const StereoImages &images, int64_t x, int64_t y, const StereoSettings &settings) {
  const int64_t width = images.left_half.width;
  const int most = static_cast<int>(std::min<int64_t>((settings.max_disparity_px + 1) / 2, x));
  const int count = most + 2; // disparities most, most - 1, …, 0, -1: both ends are beyond bounds
  const int64_t window_at = (y - coarse_radius) * width - coarse_radius;
  const uint8_t *left = images.left_half.pixels + window_at;
  const uint8_t *right = images.right_half.pixels + window_at;

  uint16_t costs[most_candidates + 64];
  scan_row(left + x, right + x - most, width, count, costs);
  // Windows that stick out of the image on the left.
  const int outside = std::max(0, static_cast<int>(most + coarse_radius - x));
  std::fill(costs, costs + outside, impossible);
  const uint16_t best = least(costs, count);
  const int best_at = static_cast<int>(std::find(costs, costs + count, best) - costs);
  if (best_at <= outside || best_at >= count - 1)
    return -1;
  const int from = std::max(0, best_at - 2), to = std::min(count, best_at + 3);
  std::fill(costs + from, costs + to, impossible);
  if (static_cast<float>(best) >= settings.uniqueness * least(costs, count))
    return -1;

  // Left-right check: seen from the right image, nothing else fits better.
  const int disparity = most - best_at;
  const int64_t right_x = x - disparity;
  const int inside = static_cast<int>(std::min<int64_t>(count, width - coarse_radius - right_x + 1));
  scan_row(right + right_x, left + right_x - 1, width, inside, costs); // disparities -1, 0, …
  const uint16_t mutual = least(costs + disparity, std::min(3, inside - disparity));
  return mutual == least(costs, inside) ? disparity : -1;
}

constexpr int fine_width = 16, fine_height = 9, fine_pixels = fine_width * fine_height;
constexpr int fine_left = fine_width / 2, fine_above = fine_height / 2;

int sum_of_differences(const uint8_t *left, const uint8_t *right, int64_t stride) {
  int sum = 0;
  for (int row = 0; row < fine_height; ++row, left += stride, right += stride)
    for (int column = 0; column < fine_width; ++column)
      sum += std::abs(left[column] - right[column]);
  return sum;
}

// The left window: its values and twice their horizontal gradient.
struct Template {
  int16_t value[fine_pixels], gradient[fine_pixels];
  int32_t gradient_sum;
  int64_t gradient_energy; // fine_pixels · Σ (G − mean G)²
  int64_t value_energy;    // fine_pixels · Σ (L − mean L)²
};

Template take_template(const uint8_t *left, int64_t stride) {
  Template window;
  int32_t sum = 0, squares = 0, value_sum = 0, value_squares = 0;
  for (int row = 0; row < fine_height; ++row)
    for (int column = 0; column < fine_width; ++column) {
      const uint8_t *pixel = left + row * stride + column;
      const auto gradient = static_cast<int16_t>(pixel[1] - pixel[-1]);
      window.value[row * fine_width + column] = *pixel;
      window.gradient[row * fine_width + column] = gradient;
      sum += gradient;
      squares += gradient * gradient;
      value_sum += *pixel;
      value_squares += *pixel * *pixel;
    }
  window.gradient_sum = sum;
  window.gradient_energy = int64_t{fine_pixels} * squares - int64_t{sum} * sum;
  window.value_energy = int64_t{fine_pixels} * value_squares - int64_t{value_sum} * value_sum;
  return window;
}

// Moments of the residual L − R at one whole disparity, times fine_pixels, means removed: exact.
struct Residual {
  int64_t along_gradient, energy;
};

Residual compare(const Template &window, const uint8_t *right, int64_t stride) {
  int32_t sum = 0, squares = 0, products = 0;
  for (int row = 0; row < fine_height; ++row, right += stride)
    for (int column = 0; column < fine_width; ++column) {
      const int at = row * fine_width + column;
      const auto residual = static_cast<int16_t>(window.value[at] - right[column]);
      sum += residual;
      squares += residual * residual;
      products += residual * window.gradient[at];
    }
  return {int64_t{fine_pixels} * products - int64_t{window.gradient_sum} * sum,
          int64_t{fine_pixels} * squares - int64_t{sum} * sum};
}

// What no shift explains of the residual, times fine_pixels.
double unexplained_energy(const Template &window, const Residual &residual) {
  const auto along = static_cast<double>(residual.along_gradient);
  const double explained = along * along / static_cast<double>(window.gradient_energy);
  return std::max(static_cast<double>(residual.energy) - explained, 0.0);
}

// σ of the least-squares shift: variance of the residual over the gradient's energy.
double shift_sigma_px(const Template &window, double unexplained) {
  // The stored gradient is a difference over two pixels: twice the derivative. 1/6 grey² is the
  // rounding noise of the two images: no patch is better than that.
  const double variance = unexplained / (double{fine_pixels} * (fine_pixels - 2));
  return std::sqrt((variance + 1.0 / 6) * 4 * fine_pixels /
                   static_cast<double>(window.gradient_energy));
}

} // namespace

bool measure_disparity(const StereoImages &images, int64_t x, int64_t y,
                       const StereoSettings &settings, float *disparity_px, float *sigma_px) {
  const int coarse = search_half(images, x / 2, y / 2, settings);
  if (coarse < 0)
    return false;
  const int64_t stride = images.left.width;
  if (x - (2 * coarse + 3) < fine_left)
    return false;
  const int64_t window_at = (y - fine_above) * stride + x - fine_left;
  const uint8_t *left = images.left.pixels + window_at;
  const uint8_t *right = images.right.pixels + window_at;

  int whole = 0, best = INT32_MAX;
  for (int d = 2 * coarse - 2; d <= 2 * coarse + 2; ++d) {
    const int cost = sum_of_differences(left, right - d, stride);
    if (cost < best) {
      best = cost;
      whole = d;
    }
  }

  const Template window = take_template(left, stride);
  if (window.gradient_energy == 0)
    return false;
  Residual low = compare(window, right - whole, stride), high = low;
  if (low.along_gradient > 0)
    low = compare(window, right - --whole, stride);
  else
    high = compare(window, right - (whole + 1), stride);
  if (low.along_gradient > 0 || high.along_gradient <= 0)
    return false; // no zero beside the best: two surfaces in the window, or no texture
  const auto below = static_cast<double>(low.along_gradient);
  const auto above = static_cast<double>(high.along_gradient);
  const double fraction = -below / (above - below);
  const double unexplained = unexplained_energy(window, fraction < 0.5 ? low : high);
  if (unexplained > settings.max_residual * static_cast<double>(window.value_energy))
    return false;
  const double noise = shift_sigma_px(window, unexplained);
  const double sigma = std::sqrt(double{settings.sigma_floor_px} * settings.sigma_floor_px +
                                 double{settings.sigma_scale} * settings.sigma_scale * noise * noise);
  *disparity_px = static_cast<float>(whole + fraction);
  *sigma_px = static_cast<float>(sigma);
  return *disparity_px >= settings.min_disparity_px &&
         *disparity_px <= static_cast<float>(settings.max_disparity_px) &&
         *sigma_px <= settings.max_sigma_px;
}

} // namespace engram::ENGRAM_ISA
