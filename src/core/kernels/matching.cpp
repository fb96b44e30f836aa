#include "kernels/matching.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "kernels/float_lanes.hpp"
#include "kernels/projection.hpp"
#include "kernels/rigid.hpp"

namespace engram::ENGRAM_ISA {
namespace {

constexpr int64_t kColumns = 32; // lanes of Shorts
constexpr int16_t kFar = 32767;

inline int popcount(uint64_t word) {
#if defined(__POPCNT__) || defined(__aarch64__)
  return __builtin_popcountll(word);
#else
  // Without an instruction for it: sums of 2, 4, 8 bits side by side. Vectorises.
  word = word - ((word >> 1) & 0x5555555555555555);
  word = (word & 0x3333333333333333) + ((word >> 2) & 0x3333333333333333);
  word = (word + (word >> 4)) & 0x0f0f0f0f0f0f0f0f;
  word += word >> 8;
  word += word >> 16;
  word += word >> 32;
  return static_cast<int>(word & 0x7f);
#endif
}

inline int hamming(const uint64_t *a, const uint64_t *b) {
  return popcount(a[0] ^ b[0]) + popcount(a[1] ^ b[1]) + popcount(a[2] ^ b[2]) +
         popcount(a[3] ^ b[3]);
}

double power(double base, int exponent) {
  double result = 1;
  for (int i = 0; i < exponent; ++i)
    result *= base;
  return result;
}

// Size in the world of a landmark's patch, and the factor by which its depth may be wrong.
struct Patch {
  double size_m;
  double doubt;
};

Patch patch_of(const FrameView &frame, int64_t row, const MatchSettings &settings) {
  const double scale = power(settings.octave_scale, frame.octaves[row]);
  const double relative_sigma = frame.disparity_sigma_px[row] / frame.disparity_px[row];
  return {scale * frame.points_in_cam[3 * row + 2] / frame.camera.fx,
          1 + settings.gate_sigmas * relative_sigma};
}

// The live landmarks in the order of their patch size, so that those of like size are neighbours;
// descriptors as four arrays of words, padded to whole blocks.
struct SortedFrame {
  std::vector<int32_t> rows;
  std::vector<double> sizes_m;
  std::vector<uint64_t> words;
  std::vector<float> u, v;
  int64_t padded;
  double most_doubt = 1;
};

SortedFrame sort_by_patch(const FrameView &frame, const MatchSettings &settings) {
  SortedFrame sorted;
  const int64_t count = frame.count;
  sorted.padded = (count + kColumns - 1) / kColumns * kColumns;
  std::vector<double> sizes(count);
  sorted.rows.resize(count);
  for (int64_t row = 0; row < count; ++row) {
    const Patch patch = patch_of(frame, row, settings);
    sizes[row] = patch.size_m;
    sorted.rows[row] = static_cast<int32_t>(row);
  }
  std::sort(sorted.rows.begin(), sorted.rows.end(), [&](int32_t a, int32_t b) {
    return sizes[a] < sizes[b] || (sizes[a] == sizes[b] && a < b);
  });
  sorted.words.assign(4 * sorted.padded, 0);
  for (int64_t column = 0; column < count; ++column) {
    const int32_t row = sorted.rows[column];
    sorted.sizes_m.push_back(sizes[row]);
    sorted.u.push_back(frame.pixels[2 * row]);
    sorted.v.push_back(frame.pixels[2 * row + 1]);
    for (int64_t word = 0; word < 4; ++word)
      std::memcpy(&sorted.words[word * sorted.padded + column], frame.descriptors + 4 * row + word,
                  sizeof(uint64_t));
  }
  return sorted;
}

// distances[j] for the columns of whole blocks; `count` columns are real, the rest is far.
void distances_to(const uint64_t *descriptor, const SortedFrame &sorted, int64_t begin, int64_t end,
                  int16_t *distances) {
  const uint64_t *words = sorted.words.data();
  const int64_t padded = sorted.padded;
  for (int64_t j = begin; j < end; ++j)
    distances[j] = static_cast<int16_t>(
        popcount(descriptor[0] ^ words[j]) + popcount(descriptor[1] ^ words[padded + j]) +
        popcount(descriptor[2] ^ words[2 * padded + j]) +
        popcount(descriptor[3] ^ words[3 * padded + j]));
  for (int64_t j = static_cast<int64_t>(sorted.rows.size()); j < end; ++j)
    distances[j] = kFar;
}

// Takes row i into the nearest row of each column; returns the smallest distance of the row.
int16_t take_row(const int16_t *distances, int16_t i, int64_t begin, int64_t end,
                 int16_t *nearest_distance, int16_t *nearest_row) {
  Shorts smallest = Shorts{} + kFar;
  const Shorts row = Shorts{} + i;
  for (int64_t j = begin; j < end; j += kColumns) {
    const Shorts here = load(distances + j), before = load(nearest_distance + j);
    const Shorts closer = here < before;
    smallest = here < smallest ? here : smallest;
    store(nearest_distance + j, closer ? here : before);
    store(nearest_row + j, closer ? row : load(nearest_row + j));
  }
  int16_t least = kFar;
  for (int lane = 0; lane < kColumns; ++lane)
    least = std::min(least, smallest[lane]);
  return least;
}

bool any(Shorts lanes) {
  typedef int64_t Longs __attribute__((vector_size(64)));
  Longs words;
  std::memcpy(&words, &lanes, sizeof words);
  int64_t all = 0;
  for (int k = 0; k < 8; ++k)
    all |= words[k];
  return all != 0;
}

bool apart(const SortedFrame &sorted, int32_t a, int32_t b, double limit_px) {
  return std::abs(sorted.u[a] - sorted.u[b]) > limit_px ||
         std::abs(sorted.v[a] - sorted.v[b]) > limit_px;
}

// The first column at the smallest distance, or -1 where another corner is nearly as close. The
// same corner found in a second octave is no rival.
int64_t distinct_column(const int16_t *distances, int64_t begin, int64_t end, int16_t least,
                        double ratio, double same_corner_px, const SortedFrame &sorted,
                        std::vector<int32_t> &close) {
  const auto limit = static_cast<int16_t>(std::min(least / ratio, 256.0));
  close.clear();
  int32_t best = -1;
  for (int64_t block = begin; block < end; block += kColumns) {
    if (!any(load(distances + block) <= limit))
      continue;
    for (auto j = static_cast<int32_t>(block); j < block + kColumns; ++j) {
      if (distances[j] > limit)
        continue;
      // Two so far apart cannot both be the best one's corner.
      if (!close.empty() && apart(sorted, close.front(), j, 2 * same_corner_px))
        return -1;
      close.push_back(j);
      if (best < 0 && distances[j] == least)
        best = j;
    }
  }
  for (const int32_t j : close)
    if (apart(sorted, j, best, same_corner_px))
      return -1;
  return best;
}

// Landmarks of a frame in cells of its image.
class Grid {
public:
  explicit Grid(const FrameView &frame) : frame_(frame) {
    float right = 0, bottom = 0;
    for (int64_t row = 0; row < frame.count; ++row) {
      right = std::max(right, frame.pixels[2 * row]);
      bottom = std::max(bottom, frame.pixels[2 * row + 1]);
    }
    right_ = right, bottom_ = bottom;
    columns_ = static_cast<int>(std::min(right, kExtent) / kCell) + 1;
    rows_ = static_cast<int>(std::min(bottom, kExtent) / kCell) + 1;
    starts_.assign(columns_ * rows_ + 1, 0);
    for (int64_t row = 0; row < frame.count; ++row)
      ++starts_[cell_of(row) + 1];
    for (size_t cell = 1; cell < starts_.size(); ++cell)
      starts_[cell] += starts_[cell - 1];
    members_.resize(frame.count);
    std::vector<int32_t> next(starts_.begin(), starts_.end() - 1);
    for (int64_t row = 0; row < frame.count; ++row)
      members_[next[cell_of(row)]++] = static_cast<int32_t>(row);
  }

  // Whether a place is closer than the margin to the image's landmarks.
  bool within(double u, double v, double margin) const {
    return u >= -margin && v >= -margin && u <= right_ + margin && v <= bottom_ + margin;
  }

  template <class Visit>
  void visit(double u, double v, double radius_u, double radius_v, Visit visit) const {
    const int left = cell(u - radius_u, columns_), right = cell(u + radius_u, columns_);
    const int top = cell(v - radius_v, rows_), bottom = cell(v + radius_v, rows_);
    for (int y = top; y <= bottom; ++y)
      for (int32_t k = starts_[y * columns_ + left]; k < starts_[y * columns_ + right + 1]; ++k) {
        const int32_t row = members_[k];
        if (std::abs(frame_.pixels[2 * row] - u) <= radius_u &&
            std::abs(frame_.pixels[2 * row + 1] - v) <= radius_v)
          visit(row);
      }
  }

private:
  static constexpr float kCell = 16;
  static constexpr float kExtent = 16384;
  static int cell(double value, int count) {
    return static_cast<int>(std::clamp(value / kCell, 0.0, count - 1.0));
  }
  int cell_of(int64_t row) const {
    return cell(frame_.pixels[2 * row + 1], rows_) * columns_ +
           cell(frame_.pixels[2 * row], columns_);
  }

  const FrameView &frame_;
  double right_, bottom_;
  int columns_, rows_;
  std::vector<int32_t> starts_, members_;
};

// Where a reference landmark should be seen, and how far from it to look.
struct Window {
  Vec3 stereo;
  Vec3 radius;
};

double variance_along(const double row[6], const std::array<double, 36> &covariance) {
  double total = 0;
  for (int a = 0; a < 6; ++a) {
    double cross = 0.5 * covariance[7 * a] * row[a];
    for (int b = 0; b < a; ++b)
      cross += covariance[6 * a + b] * row[b];
    total += 2 * row[a] * cross;
  }
  return total;
}

bool predict(const FrameView &reference, int64_t row, const FrameView &live, const Grid &grid,
             const Prediction &prediction, const MatchSettings &settings, Window &window) {
  const float *p = reference.points_in_cam + 3 * row;
  const Vec3 point = {p[0], p[1], p[2]};
  const Vec3 in_live = transform_back(prediction.reference_from_live, point);
  if (in_live[2] <= kNearest_m)
    return false;
  window.stereo = project(live.camera, in_live);
  if (!grid.within(window.stereo[0], window.stereo[1], settings.max_radius_px))
    return false;
  const Linearised seen = linearise(live.camera, prediction.reference_from_live, point);
  const double sigma = reference.disparity_sigma_px[row], disparity = reference.disparity_px[row];
  const double offset = settings.offset_sigma_px;
  const double depth_variance = (sigma * sigma + offset * offset) / (disparity * disparity);
  const double scale = power(settings.octave_scale, reference.octaves[row]);
  const double pixel = settings.pixel_sigma_px * (scale + 1);
  for (int k = 0; k < 3; ++k) {
    const double variance = pixel * pixel +
                            depth_variance * seen.by_depth[k] * seen.by_depth[k] +
                            variance_along(seen.by_pose[k], prediction.covariance);
    window.radius[k] =
        std::min(settings.gate_sigmas * std::sqrt(std::max(variance, 0.0)), settings.max_radius_px);
  }
  return true;
}

} // namespace

void match_all(const FrameView &reference, const FrameView &live, const MatchSettings &settings,
               std::vector<RowPair> &pairs) {
  pairs.clear();
  if (reference.count == 0 || live.count == 0)
    return;
  const SortedFrame sorted = sort_by_patch(live, settings);
  std::vector<int16_t> distances(sorted.padded, kFar), nearest_distance(sorted.padded, kFar),
      nearest_row(sorted.padded, -1);
  std::vector<RowPair> forward; // `live` is still a column
  std::vector<int32_t> close;
  for (int64_t i = 0; i < reference.count; ++i) {
    const Patch patch = patch_of(reference, i, settings);
    const double reach = settings.patch_ratio * patch.doubt * patch.doubt;
    const auto first = std::lower_bound(sorted.sizes_m.begin(), sorted.sizes_m.end(),
                                        patch.size_m / reach);
    const auto last = std::upper_bound(first, sorted.sizes_m.end(), patch.size_m * reach);
    const int64_t begin = (first - sorted.sizes_m.begin()) / kColumns * kColumns;
    const int64_t end = (last - sorted.sizes_m.begin() + kColumns - 1) / kColumns * kColumns;
    if (first == last)
      continue;
    uint64_t descriptor[4];
    std::memcpy(descriptor, reference.descriptors + 4 * i, sizeof descriptor);
    distances_to(descriptor, sorted, begin, end, distances.data());
    const int16_t least = take_row(distances.data(), static_cast<int16_t>(i), begin, end,
                                   nearest_distance.data(), nearest_row.data());
    if (least > settings.max_distance)
      continue;
    const int64_t column = distinct_column(distances.data(), begin, end, least, settings.ratio,
                                           settings.same_corner_px, sorted, close);
    if (column >= 0)
      forward.push_back({static_cast<int32_t>(i), static_cast<int32_t>(column), least});
  }
  for (const RowPair &pair : forward)
    if (nearest_row[pair.live] == pair.reference)
      pairs.push_back({pair.reference, sorted.rows[pair.live], pair.distance});
}

void match_near(const FrameView &reference, const FrameView &live, const Prediction &prediction,
                const MatchSettings &settings, std::vector<RowPair> &pairs) {
  pairs.clear();
  if (reference.count == 0 || live.count == 0)
    return;
  const Grid grid(live);
  std::vector<int32_t> nearest_distance(live.count, kFar), nearest_row(live.count, -1);
  std::vector<std::pair<int32_t, int32_t>> candidates; // distance, live row
  for (int64_t i = 0; i < reference.count; ++i) {
    Window window;
    if (!predict(reference, i, live, grid, prediction, settings, window))
      continue;
    uint64_t descriptor[4];
    std::memcpy(descriptor, reference.descriptors + 4 * i, sizeof descriptor);
    candidates.clear();
    grid.visit(window.stereo[0], window.stereo[1], window.radius[0], window.radius[1],
               [&](int32_t j) {
                 const double reach =
                     window.radius[2] + settings.gate_sigmas * live.disparity_sigma_px[j];
                 if (std::abs(live.disparity_px[j] - window.stereo[2]) > reach)
                   return;
                 uint64_t other[4];
                 std::memcpy(other, live.descriptors + 4 * j, sizeof other);
                 candidates.emplace_back(hamming(descriptor, other), j);
               });
    if (candidates.empty())
      continue;
    for (const auto &[distance, j] : candidates)
      if (distance < nearest_distance[j]) {
        nearest_distance[j] = distance;
        nearest_row[j] = static_cast<int32_t>(i);
      }
    const auto best = *std::min_element(candidates.begin(), candidates.end());
    if (best.first > settings.max_guided_distance)
      continue;
    const float *corner = live.pixels + 2 * best.second;
    const bool distinct = std::none_of(candidates.begin(), candidates.end(), [&](const auto &c) {
      return c.first * settings.guided_ratio <= best.first &&
             (std::abs(live.pixels[2 * c.second] - corner[0]) > settings.same_corner_px ||
              std::abs(live.pixels[2 * c.second + 1] - corner[1]) > settings.same_corner_px);
    });
    if (distinct)
      pairs.push_back({static_cast<int32_t>(i), best.second, best.first});
  }
  std::erase_if(pairs, [&](const RowPair &p) { return nearest_row[p.live] != p.reference; });
}

} // namespace engram::ENGRAM_ISA
