#include "kernels/disparity.hpp"

#include <algorithm>
#include <cmath>

#include "kernels/lanes.hpp"
#include "kernels/stereo_window.hpp"

namespace engram::ENGRAM_ISA {
namespace {

constexpr int coarse_radius = 3;
constexpr int coarse_side = 2 * coarse_radius + 1;
// Differences count up to this: occlusions and highlights cannot outvote the rest, and the sum over
// a row of the window fits a byte.
constexpr uint8_t coarse_cap = 255 / coarse_side;

// Signed: every instruction set compares such; costs stay far below.
typedef int16_t Costs __attribute__((vector_size(lanes)));
constexpr int16_t impossible = 32767;

// Costs of disparities k = 0, 1, …, even and odd ones apart, in vectors that hold `lanes` of them.
template <int vectors> struct CostRow {
  Costs even[vectors], odd[vectors];

  // Calls work(costs, first, step) of each vector: its lanes are first, first + 2, ….
  template <class Work> void each(Work work) {
    for (int v = 0; v < vectors; ++v) {
      work(even[v], v * lanes);
      work(odd[v], v * lanes + 1);
    }
  }

  // Makes disparities outside [from, to) impossible; drop(), those inside.
  void keep(int from, int to) {
    each([&](Costs &costs, int first) {
      const Costs k = numbers() + static_cast<int16_t>(first);
      costs = ((k >= static_cast<int16_t>(from)) & (k < static_cast<int16_t>(to))) ? costs : none();
    });
  }
  void drop(int from, int to) {
    each([&](Costs &costs, int first) {
      const Costs k = numbers() + static_cast<int16_t>(first);
      costs = ((k >= static_cast<int16_t>(from)) & (k < static_cast<int16_t>(to))) ? none() : costs;
    });
  }

  int16_t least() {
    Costs best = none();
    each([&](const Costs &costs, int) { best = costs < best ? costs : best; });
    return least_lane(best);
  }

  // The first disparity of a cost that occurs.
  int first_of(int16_t cost) {
    int first = vectors * lanes;
    each([&](const Costs &costs, int from) {
      if (const uint64_t bits = bits_of((Bytes)(costs == cost)); bits != 0)
        first = std::min(first, from + __builtin_ctzll(bits)); // two bytes to a lane
    });
    return first;
  }

private:
  static Costs none() { return Costs{} + impossible; }
  static Costs numbers() {
    Costs k;
    for (int lane = 0; lane < lanes / 2; ++lane)
      k[lane] = static_cast<int16_t>(2 * lane);
    return k;
  }
  static int16_t least_lane(Costs costs) {
    const auto least = [](auto a, auto b) { return a < b ? a : b; };
#if defined(__AVX512BW__)
    const auto half = least(
        __builtin_shufflevector(costs, costs, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15),
        __builtin_shufflevector(costs, costs, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28,
                                29, 30, 31));
#else
    const auto half = costs;
#endif
#if defined(__AVX2__)
    const auto eight = least(__builtin_shufflevector(half, half, 0, 1, 2, 3, 4, 5, 6, 7),
                             __builtin_shufflevector(half, half, 8, 9, 10, 11, 12, 13, 14, 15));
    return static_cast<int16_t>(_mm_extract_epi16(_mm_minpos_epu16((__m128i)eight), 0));
#else
    const auto four = least(half, __builtin_shufflevector(half, half, 4, 5, 6, 7, 0, 1, 2, 3));
    const auto two = least(four, __builtin_shufflevector(four, four, 2, 3, 0, 1, 6, 7, 4, 5));
    return two[0] < two[1] ? two[0] : two[1];
#endif
  }
};

// Truncated SAD between the window whose upper left pixel is `window`, and those at `searched` + k;
// reads `lanes` · vectors pixels of each row.
template <int vectors>
CostRow<vectors> scan(const uint8_t *window, const uint8_t *searched, int64_t stride) {
  CostRow<vectors> costs;
  for (int v = 0; v < vectors; ++v) {
    Words even{}, odd{};
    for (int row = 0; row < coarse_side; ++row) {
      Bytes sum{};
      for (int column = 0; column < coarse_side; ++column) {
        const Bytes there = load<Bytes>(searched + row * stride + column + v * lanes);
        sum += smaller(distance(all(window[row * stride + column]), there), all(coarse_cap));
      }
      even += (Words)sum & 255;
      odd += (Words)sum >> 8;
    }
    costs.even[v] = (Costs)even;
    costs.odd[v] = (Costs)odd;
  }
  return costs;
}

// The whole disparity at half resolution, or -1.
template <int vectors>
int search_half(const StereoImages &images, int64_t x, int64_t y, const StereoSettings &settings) {
  const int64_t width = images.left_half.width;
  const int most = static_cast<int>(std::min<int64_t>((settings.max_disparity_px + 1) / 2, x));
  const int count = most + 2; // disparities most, most - 1, …, 0, -1: both ends are beyond bounds
  const int64_t window_at = (y - coarse_radius) * width - coarse_radius;
  const uint8_t *left = images.left_half.pixels + window_at;
  const uint8_t *right = images.right_half.pixels + window_at;

  auto costs = scan<vectors>(left + x, right + x - most, width);
  // Windows that stick out of the image on the left.
  const int outside = std::max(0, static_cast<int>(most + coarse_radius - x));
  costs.keep(outside, count);
  const int16_t best = costs.least();
  const int best_at = costs.first_of(best);
  if (best_at <= outside || best_at >= count - 1)
    return -1;
  costs.drop(best_at - 2, best_at + 3);
  const int16_t next = costs.least();
  constexpr float kNothingElse = 65535;
  if (static_cast<float>(best) >=
      settings.uniqueness * (next == impossible ? kNothingElse : static_cast<float>(next)))
    return -1;

  // Left-right check: seen from the right image, nothing else fits better.
  const int disparity = most - best_at;
  const int64_t right_x = x - disparity;
  const int inside = static_cast<int>(std::min<int64_t>(count, width - coarse_radius - right_x + 1));
  auto back = scan<vectors>(right + right_x, left + right_x - 1, width); // disparities -1, 0, …
  back.keep(0, inside);
  const int16_t least = back.least();
  back.keep(disparity, std::min(disparity + 3, inside));
  return back.least() == least ? disparity : -1;
}

int search_half(const StereoImages &images, int64_t x, int64_t y, const StereoSettings &settings) {
  // As few vectors as hold them all: a scan reads no farther past its row than rows are below it.
  const int64_t count = std::min<int64_t>((settings.max_disparity_px + 1) / 2, x) + 2;
  return count <= 64    ? search_half<64 / lanes>(images, x, y, settings)
         : count <= 128 ? search_half<128 / lanes>(images, x, y, settings)
                        : search_half<256 / lanes>(images, x, y, settings);
}

constexpr int fine_left = fine_width / 2, fine_above = fine_height / 2;

// Brightness and contrast of a window, exact.
struct Levels {
  int32_t sum;
  int64_t energy; // fine_pixels · Σ (value − mean)²
};

Levels levels_of(const uint8_t *window, int64_t stride) {
  const Pixels ones = Pixels{} + int16_t{1};
  Totals sums{}, squares{};
  for (int part = 0; part < kWindowParts; ++part) {
    const Pixels value = pixels_of(window, stride, part);
    sums = plus_products(sums, value, ones);
    squares = plus_products(squares, value, value);
  }
  const int32_t sum = total_of(sums);
  return {sum, int64_t{fine_pixels} * total_of(squares) - int64_t{sum} * sum};
}

// The left window: its values and twice their horizontal gradient.
struct Template {
  FineWindow value, gradient;
  int32_t gradient_sum;
  int64_t gradient_energy; // fine_pixels · Σ (G − mean G)²
  Levels levels;
};

Template take_template(const uint8_t *left, int64_t stride) {
  const Pixels ones = Pixels{} + int16_t{1};
  Template window;
  Totals sums{}, squares{};
  for (int part = 0; part < kWindowParts; ++part) {
    window.value[part] = pixels_of(left, stride, part);
    const Pixels gradient = window.gradient[part] =
        pixels_of(left + 1, stride, part) - pixels_of(left - 1, stride, part);
    sums = plus_products(sums, gradient, ones);
    squares = plus_products(squares, gradient, gradient);
  }
  const int32_t sum = total_of(sums);
  window.gradient_sum = sum;
  window.gradient_energy = int64_t{fine_pixels} * total_of(squares) - int64_t{sum} * sum;
  window.levels = levels_of(left, stride);
  return window;
}

// Moments of the residual L − R at one whole disparity, times fine_pixels, means removed: exact.
struct Residual {
  int64_t along_gradient, energy;
};

Residual compare(const Template &window, const uint8_t *right, int64_t stride) {
  const Pixels ones = Pixels{} + int16_t{1};
  Totals sums{}, squares{}, products{};
  for (int part = 0; part < kWindowParts; ++part) {
    const Pixels residual = window.value[part] - pixels_of(right, stride, part);
    sums = plus_products(sums, residual, ones);
    squares = plus_products(squares, residual, residual);
    products = plus_products(products, residual, window.gradient[part]);
  }
  const int32_t sum = total_of(sums);
  return {int64_t{fine_pixels} * total_of(products) - int64_t{window.gradient_sum} * sum,
          int64_t{fine_pixels} * total_of(squares) - int64_t{sum} * sum};
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

// What the fine search reads of the right image, so far to either side of its window; rows are as
// long as vectors have it, and longer than they need be.
constexpr int strip_reach = 3, strip_stride = 32;

struct Strip {
  uint8_t pixels[fine_height * strip_stride];

  const uint8_t *window() const { return pixels + strip_reach; }
};

// Brings the right image about a window to the brightness and contrast of the left one.
void bring(const uint8_t *right, int64_t stride, const Levels &left, Strip &strip) {
  const Levels own = levels_of(right, stride);
  // Of a window without contrast only noise is left, whatever it is multiplied with.
  const auto gain = static_cast<float>(std::sqrt(
      static_cast<double>(left.energy) / static_cast<double>(std::max<int64_t>(own.energy, 1))));
  const float from = static_cast<float>(own.sum) / fine_pixels;
  const float to = static_cast<float>(left.sum) / fine_pixels + 0.5f;
  for (int row = 0; row < fine_height; ++row) {
    const uint8_t *__restrict__ pixels = right + row * stride - strip_reach;
    uint8_t *__restrict__ brought = strip.pixels + row * strip_stride;
    for (int column = 0; column < strip_stride; ++column) {
      const float level = to + gain * (static_cast<float>(pixels[column]) - from);
      brought[column] =
          static_cast<uint8_t>(static_cast<int32_t>(std::min(std::max(level, 0.0f), 255.0f)));
    }
  }
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
  int64_t right_stride = stride;
  const Template window = take_template(left, stride);
  if (window.gradient_energy == 0)
    return false;
  Strip strip;
  if (images.sides_differ) {
    bring(right - 2 * coarse, stride, window.levels, strip);
    right = strip.window() + 2 * coarse;
    right_stride = strip_stride;
  }

  int whole = 0, best = INT32_MAX;
  for (int d = 2 * coarse - 2; d <= 2 * coarse + 2; ++d) {
    const int cost = sum_of_differences(left, stride, right - d, right_stride);
    if (cost < best) {
      best = cost;
      whole = d;
    }
  }

  Residual low = compare(window, right - whole, right_stride), high = low;
  if (low.along_gradient > 0)
    low = compare(window, right - --whole, right_stride);
  else
    high = compare(window, right - (whole + 1), right_stride);
  if (low.along_gradient > 0 || high.along_gradient <= 0)
    return false; // no zero beside the best: two surfaces in the window, or no texture
  const auto below = static_cast<double>(low.along_gradient);
  const auto above = static_cast<double>(high.along_gradient);
  const double fraction = -below / (above - below);
  const double unexplained = unexplained_energy(window, fraction < 0.5 ? low : high);
  if (unexplained > settings.max_residual * static_cast<double>(window.levels.energy))
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
