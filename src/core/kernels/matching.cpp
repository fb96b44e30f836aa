#include "kernels/matching.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#ifdef __AVX512VPOPCNTDQ__
#include <immintrin.h>
#endif

#include "kernels/double_lanes.hpp"
#include "kernels/float_lanes.hpp"
#include "kernels/projection.hpp"
#include "kernels/rigid.hpp"
#include "kernels/width.hpp"

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

// A descriptor, wherever it stands in memory, as words that may be loaded.
template <class Width> struct Descriptor {
  uint64_t words[most_words(Width{})];

  Descriptor(const uint64_t *from, Width width) {
    std::memcpy(words, from, sizeof(uint64_t) * width);
  }
};

template <class Width> int hamming(const uint64_t *a, const uint64_t *b, Width width) {
  int bits = 0;
  for (int word = 0; word < width; ++word) {
    uint64_t other;
    std::memcpy(&other, b + word, sizeof other);
    bits += popcount(a[word] ^ other);
  }
  return bits;
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

// The live landmarks in blocks of 32, those of like patch size together.
struct Blocks {
  std::vector<int32_t> rows; // of the live frame, by column
  std::vector<float> u, v;
  // Descriptors, block by block: word w of landmark 4 i + g of a block stands at 32 w + 8 g + i, so
  // that four vectors of counts in 64 bits shift into one of 16 bits.
  std::vector<uint64_t> words;
  int width; // words of a descriptor
  std::vector<double> least_m, most_m; // patch sizes in a block
  Shorts beyond{};                     // in the last block: far where there is no landmark

  int64_t count() const { return static_cast<int64_t>(least_m.size()); }
};

// In the order of their size, but for 3 %: blocks are compared by their true bounds.
std::vector<int32_t> rows_by_size(const std::vector<double> &sizes) {
  constexpr int kBuckets = 1024; // of 1/32 octave, from 2⁻¹⁶ m on
  const auto bucket_of = [](double size) {
    const auto exact = static_cast<float>(size);
    int32_t bits;
    std::memcpy(&bits, &exact, sizeof bits);
    return std::clamp((bits >> 18) - (111 << 5), 0, kBuckets - 1);
  };
  std::array<int32_t, kBuckets + 1> starts{};
  for (const double size : sizes)
    ++starts[bucket_of(size) + 1];
  for (int bucket = 0; bucket < kBuckets; ++bucket)
    starts[bucket + 1] += starts[bucket];
  std::vector<int32_t> rows(sizes.size());
  for (size_t row = 0; row < sizes.size(); ++row)
    rows[starts[bucket_of(sizes[row])]++] = static_cast<int32_t>(row);
  return rows;
}

template <class Width>
Blocks blocks_of(const FrameView &frame, const MatchSettings &settings, Width width) {
  Blocks blocks;
  blocks.width = width;
  std::vector<double> sizes(frame.count);
  for (int64_t row = 0; row < frame.count; ++row)
    sizes[row] = patch_of(frame, row, settings).size_m;
  blocks.rows = rows_by_size(sizes);
  const int64_t count = (frame.count + kColumns - 1) / kColumns;
  blocks.words.resize(count * width * kColumns);
  blocks.least_m.assign(count, std::numeric_limits<double>::max());
  blocks.most_m.assign(count, 0);
  blocks.u.resize(frame.count), blocks.v.resize(frame.count);
  for (int64_t column = 0; column < frame.count; ++column) {
    const int32_t row = blocks.rows[column];
    const int64_t block = column / kColumns, within = column % kColumns;
    blocks.u[column] = frame.pixels[2 * row];
    blocks.v[column] = frame.pixels[2 * row + 1];
    blocks.least_m[block] = std::min(blocks.least_m[block], sizes[row]);
    blocks.most_m[block] = std::max(blocks.most_m[block], sizes[row]);
    uint64_t *words = &blocks.words[block * width * kColumns + 8 * (within % 4) + within / 4];
    for (int64_t word = 0; word < width; ++word)
      std::memcpy(words + kColumns * word, frame.descriptors + width * row + word,
                  sizeof(uint64_t));
  }
  for (int64_t lane = frame.count - kColumns * (count - 1); lane < kColumns; ++lane)
    blocks.beyond[lane] = kFar;
  return blocks;
}

// Bits in which the descriptor differs from each of a block.
template <class Width>
Shorts distances_to(const uint64_t *descriptor, const uint64_t *block, Width width) {
#ifdef __AVX512VPOPCNTDQ__
  typedef uint64_t Counts __attribute__((vector_size(64)));
  Counts totals[4] = {};
  for (int group = 0; group < 4; ++group)
    for (int word = 0; word < width; ++word) {
      Counts other;
      std::memcpy(&other, block + kColumns * word + 8 * group, sizeof other);
      totals[group] += (Counts)_mm512_popcnt_epi64((__m512i)(descriptor[word] ^ other));
    }
  return (Shorts)((totals[0] | totals[1] << 16) | (totals[2] | totals[3] << 16) << 32);
#else
  int32_t totals[kColumns];
  for (int64_t column = 0; column < kColumns; ++column) {
    totals[column] = 0;
    for (int word = 0; word < width; ++word)
      totals[column] += popcount(descriptor[word] ^ block[kColumns * word + column]);
  }
  int16_t distances[kColumns];
  for (int i = 0; i < 8; ++i)
    for (int group = 0; group < 4; ++group)
      distances[4 * i + group] = static_cast<int16_t>(totals[8 * group + i]);
  return load(distances);
#endif
}

int16_t least_of(Shorts lanes) {
  typedef int16_t Half __attribute__((vector_size(32)));
  typedef int16_t Quarter __attribute__((vector_size(16)));
  Half halves[2];
  std::memcpy(halves, &lanes, sizeof halves);
  const Half half = halves[0] < halves[1] ? halves[0] : halves[1];
  Quarter quarters[2];
  std::memcpy(quarters, &half, sizeof quarters);
  const Quarter quarter = quarters[0] < quarters[1] ? quarters[0] : quarters[1];
  int16_t least = kFar;
  for (int lane = 0; lane < 8; ++lane)
    least = std::min(least, quarter[lane]);
  return least;
}

// Distances of one reference landmark to the blocks of like size, and of each column to the nearest
// of all reference landmarks.
class Distances {
public:
  explicit Distances(const Blocks &blocks)
      : blocks_(blocks), here_(blocks.count()), nearest_(blocks.count(), Shorts{} + kFar),
        nearest_row_(blocks.count(), Shorts{} - int16_t{1}) {}

  // Returns the least. Out of line, so that the descriptor stays in registers over all blocks.
  template <class Width>
  [[gnu::noinline]] int16_t measure(const uint64_t *descriptor, int16_t row, double least_m, double most_m,
                  Width width) {
    touched_.clear();
    Shorts smallest = Shorts{} + kFar;
    for (int64_t block = 0; block < blocks_.count(); ++block) {
      if (blocks_.most_m[block] < least_m || blocks_.least_m[block] > most_m)
        continue;
      Shorts here = distances_to(descriptor, &blocks_.words[block * width * kColumns], width);
      if (block == blocks_.count() - 1)
        here |= blocks_.beyond;
      const Shorts before = nearest_[block], closer = here < before;
      smallest = here < smallest ? here : smallest;
      here_[block] = here;
      nearest_[block] = closer ? here : before;
      nearest_row_[block] = closer ? Shorts{} + row : nearest_row_[block];
      touched_.push_back(static_cast<int32_t>(block));
    }
    return least_of(smallest);
  }

  // Calls visit(column, distance) for those measured last within the limit, until it returns false.
  template <class Visit> void within(int16_t limit, Visit visit) const {
    for (const int32_t block : touched_)
      for (uint32_t bits = bits_of(here_[block] <= limit); bits != 0; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        if (!visit(static_cast<int32_t>(kColumns * block + lane), here_[block][lane]))
          return;
      }
  }

  int16_t nearest_row(int32_t column) const {
    return nearest_row_[column / kColumns][column % kColumns];
  }

private:
  const Blocks &blocks_;
  std::vector<Shorts> here_, nearest_, nearest_row_;
  std::vector<int32_t> touched_;
};

bool apart(const Blocks &blocks, int32_t a, int32_t b, double limit_px) {
  return std::abs(blocks.u[a] - blocks.u[b]) > limit_px ||
         std::abs(blocks.v[a] - blocks.v[b]) > limit_px;
}

// The first column at the smallest distance, or -1 where another corner is nearly as close. The
// same corner found in a second octave is no rival.
int32_t distinct_column(const Distances &distances, int16_t least, const MatchSettings &settings,
                        const Blocks &blocks, std::vector<int32_t> &close) {
  const auto limit = static_cast<int16_t>(std::min(least / settings.ratio, 64.0 * blocks.width));
  close.clear();
  int32_t best = -1;
  distances.within(limit, [&](int32_t column, int16_t distance) {
    // Two so far apart cannot both be the best one's corner.
    if (!close.empty() && apart(blocks, close.front(), column, 2 * settings.same_corner_px)) {
      best = -1;
      close.clear();
      return false;
    }
    close.push_back(column);
    if (best < 0 && distance == least)
      best = column;
    return true;
  });
  for (const int32_t column : close)
    if (apart(blocks, column, best, settings.same_corner_px))
      return -1;
  return best;
}

Floats magnitude(Floats lanes) { return lanes < 0.0f ? -lanes : lanes; }

// Landmarks of a frame in strips across its image, from top to bottom. A window is as wide as the
// prediction is vague, up to most of the image, so that sixteen landmarks are tested at once.
class Strips {
public:
  Strips(const FrameView &frame, double gate_sigmas) {
    for (int64_t row = 0; row < frame.count; ++row) {
      right_ = std::max(right_, frame.pixels[2 * row]);
      bottom_ = std::max(bottom_, frame.pixels[2 * row + 1]);
    }
    count_ = static_cast<int>(std::min(bottom_, kExtent) / kHeight) + 1;
    starts_.assign(count_ + 1, 0);
    for (int64_t row = 0; row < frame.count; ++row)
      ++starts_[strip(frame.pixels[2 * row + 1]) + 1];
    for (int k = 0; k < count_; ++k)
      starts_[k + 1] += starts_[k];
    std::vector<int32_t> next(starts_.begin(), starts_.end() - 1);
    rows_.resize(frame.count);
    for (int64_t row = 0; row < frame.count; ++row)
      rows_[next[strip(frame.pixels[2 * row + 1])]++] = static_cast<int32_t>(row);
    constexpr float kNowhere = 1e30f; // in the padding
    for (auto *values : {&u_, &v_, &disparity_, &reach_})
      values->assign(frame.count + kLanes, kNowhere);
    for (int64_t place = 0; place < frame.count; ++place) {
      const int32_t row = rows_[place];
      u_[place] = frame.pixels[2 * row], v_[place] = frame.pixels[2 * row + 1];
      disparity_[place] = frame.disparity_px[row];
      reach_[place] = static_cast<float>(gate_sigmas * frame.disparity_sigma_px[row]);
    }
  }

  // Whether a place is closer than the margin to the image's landmarks.
  bool within(double u, double v, double margin) const {
    return u >= -margin && v >= -margin && u <= right_ + margin && v <= bottom_ + margin;
  }

  // Calls visit(row) for the landmarks whose (u, v, disparity) lie within the radius; that of the
  // disparity is widened by their own doubt.
  template <class Visit>
  void visit(const std::array<float, 3> &centre, const std::array<float, 3> &radius,
             Visit visit) const {
    const int32_t begin = starts_[strip(centre[1] - radius[1])];
    const int32_t end = starts_[strip(centre[1] + radius[1]) + 1];
    // A block may reach into the strips below, which are too far away, and into the padding.
    for (int32_t k = begin; k < end; k += kLanes) {
      const Ints near = (magnitude(load(&u_[k]) - centre[0]) <= radius[0]) &
                        (magnitude(load(&v_[k]) - centre[1]) <= radius[1]) &
                        (magnitude(load(&disparity_[k]) - centre[2]) <=
                         radius[2] + load(&reach_[k]));
      for (uint32_t bits = bits_of(near); bits != 0; bits &= bits - 1)
        if (const int32_t place = k + __builtin_ctz(bits); place < end)
          visit(rows_[place]);
    }
  }

private:
  static constexpr float kHeight = 8;
  static constexpr float kExtent = 16384;

  int strip(float v) const {
    const float number = v / kHeight;
    return number >= static_cast<float>(count_ - 1) ? count_ - 1
           : number > 0                             ? static_cast<int>(number)
                                                    : 0;
  }

  float right_ = 0, bottom_ = 0;
  int count_;
  std::vector<int32_t> starts_, rows_;
  std::vector<float> u_, v_, disparity_, reach_;
};

// Where reference landmarks should be seen, how far from there to look, and whether to look at all.
struct Windows {
  Vec3Lanes stereo, radius;
  Longs worth;
};

class Predictor {
public:
  Predictor(const FrameView &reference, const Camera &live, const Prediction &prediction,
            const MatchSettings &settings)
      : reference_(reference), live_(live), settings_(settings), covariance_(prediction.covariance),
        live_from_reference_(inverse(prediction.reference_from_live)) {
    int most = 0;
    for (int64_t row = 0; row < reference.count; ++row)
      most = std::max<int>(most, reference.octaves[row]);
    for (int octave = 0; octave <= most; ++octave)
      pixel_variances_.push_back(
          square(settings.pixel_sigma_px * (power(settings.octave_scale, octave) + 1)));
  }

  // Of the landmarks from `row` on; lanes past the last one repeat it.
  Windows windows(int64_t row) const {
    Vec3Lanes point{};
    Doubles pixel_variance{}, depth_variance{};
    for (int lane = 0; lane < kDoubleLanes; ++lane) {
      const int64_t at = std::min(row + lane, reference_.count - 1);
      for (int i = 0; i < 3; ++i)
        point[i][lane] = reference_.points_in_cam[3 * at + i];
      const double disparity = reference_.disparity_px[at];
      pixel_variance[lane] = pixel_variances_[reference_.octaves[at]];
      depth_variance[lane] =
          (square(reference_.disparity_sigma_px[at]) + square(settings_.offset_sigma_px)) /
          square(disparity);
    }
    return windows(point, pixel_variance, depth_variance);
  }

private:
  static double square(double x) { return x * x; }

  Windows windows(const Vec3Lanes &point, Doubles pixel_variance, Doubles depth_variance) const {
    const auto &r = live_from_reference_.rotation;
    Vec3Lanes ray, seen;
    for (int i = 0; i < 3; ++i) {
      ray[i] = r[3 * i] * point[0] + r[3 * i + 1] * point[1] + r[3 * i + 2] * point[2];
      seen[i] = ray[i] + live_from_reference_.translation[i];
    }
    Windows result;
    result.worth = seen[2] > kNearest_m;
    const Doubles iz = 1.0 / (result.worth ? seen[2] : Doubles{} + 1.0);
    const Doubles along_u = live_.fx * iz, along_v = live_.fy * iz, d = along_u * live_.baseline_m;
    result.stereo = {along_u * seen[0] + live_.cx, along_v * seen[1] + live_.cy, d};
    // By the point, in the live camera; then by the pose, and by the depth along the ray.
    const Doubles zero{};
    const Vec3Lanes gradients[3] = {{along_u, zero, -along_u * seen[0] * iz},
                                    {zero, along_v, -along_v * seen[1] * iz},
                                    {zero, zero, -d * iz}};
    for (int k = 0; k < 3; ++k) {
      const Vec3Lanes &g = gradients[k];
      Vec3Lanes moving;
      for (int i = 0; i < 3; ++i)
        moving[i] = -(r[i] * g[0] + r[3 + i] * g[1] + r[6 + i] * g[2]);
      const Vec3Lanes turning = cross(point, moving);
      const Doubles by_depth = dot(g, ray);
      const Doubles variance = pixel_variance + depth_variance * by_depth * by_depth +
                               variance_along({moving[0], moving[1], moving[2], turning[0],
                                               turning[1], turning[2]});
      for (int lane = 0; lane < kDoubleLanes; ++lane) {
        const double radius = settings_.gate_sigmas * std::sqrt(std::max(variance[lane], 0.0));
        // So that what is no number becomes the bound.
        result.radius[k][lane] =
            radius < settings_.max_radius_px ? radius : settings_.max_radius_px;
      }
    }
    return result;
  }

  Doubles variance_along(const std::array<Doubles, 6> &row) const {
    Doubles total{};
    for (int a = 0; a < 6; ++a) {
      Doubles cross = 0.5 * covariance_[7 * a] * row[a];
      for (int b = 0; b < a; ++b)
        cross += covariance_[6 * a + b] * row[b];
      total += 2.0 * row[a] * cross;
    }
    return total;
  }

  const FrameView &reference_;
  const Camera &live_;
  const MatchSettings &settings_;
  const std::array<double, 36> &covariance_;
  Pose live_from_reference_;
  std::vector<double> pixel_variances_; // by octave
};

template <class Width>
void match_all(const FrameView &reference, const FrameView &live, const MatchSettings &settings,
               std::vector<RowPair> &pairs, Width width) {
  pairs.clear();
  if (reference.count == 0 || live.count == 0)
    return;
  const Blocks blocks = blocks_of(live, settings, width);
  Distances distances(blocks);
  std::vector<RowPair> forward; // `live` is still a column
  std::vector<int32_t> close;
  for (int64_t i = 0; i < reference.count; ++i) {
    const Patch patch = patch_of(reference, i, settings);
    const double reach = settings.patch_ratio * patch.doubt * patch.doubt;
    const Descriptor<Width> descriptor(reference.descriptors + width * i, width);
    const int16_t least = distances.measure(descriptor.words, static_cast<int16_t>(i),
                                            patch.size_m / reach, patch.size_m * reach, width);
    if (least > settings.max_distance)
      continue;
    const int32_t column = distinct_column(distances, least, settings, blocks, close);
    if (column >= 0)
      forward.push_back({static_cast<int32_t>(i), column, least});
  }
  for (const RowPair &pair : forward)
    if (distances.nearest_row(pair.live) == pair.reference)
      pairs.push_back({pair.reference, blocks.rows[pair.live], pair.distance});
}

template <class Width>
void match_near(const FrameView &reference, const FrameView &live, const Prediction &prediction,
                const MatchSettings &settings, std::vector<RowPair> &pairs, Width width) {
  pairs.clear();
  if (reference.count == 0 || live.count == 0)
    return;
  const Strips strips(live, settings.gate_sigmas);
  std::vector<int32_t> nearest_distance(live.count, kFar), nearest_row(live.count, -1);
  std::vector<std::pair<int32_t, int32_t>> candidates; // distance, live row
  candidates.reserve(live.count);
  const Predictor predictor(reference, live.camera, prediction, settings);
  Windows windows;
  for (int64_t i = 0; i < reference.count; ++i) {
    const int lane = static_cast<int>(i % kDoubleLanes);
    if (lane == 0)
      windows = predictor.windows(i);
    const double u = windows.stereo[0][lane], v = windows.stereo[1][lane];
    if (!windows.worth[lane] || !strips.within(u, v, settings.max_radius_px))
      continue;
    const Descriptor<Width> descriptor(reference.descriptors + width * i, width);
    std::array<float, 3> centre, radius;
    for (int k = 0; k < 3; ++k) {
      centre[k] = static_cast<float>(windows.stereo[k][lane]);
      radius[k] = static_cast<float>(windows.radius[k][lane]);
    }
    candidates.clear();
    std::pair<int32_t, int32_t> best{kFar, -1};
    strips.visit(centre, radius, [&](int32_t j) {
      const int32_t distance = hamming(descriptor.words, live.descriptors + width * j, width);
      candidates.emplace_back(distance, j);
      best = std::min(best, candidates.back());
      const bool closer = distance < nearest_distance[j];
      nearest_distance[j] = closer ? distance : nearest_distance[j];
      nearest_row[j] = closer ? static_cast<int32_t>(i) : nearest_row[j];
    });
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

} // namespace

void match_all(const FrameView &reference, const FrameView &live, const MatchSettings &settings,
               std::vector<RowPair> &pairs) {
  with_width(live.width, [&](auto width) { match_all(reference, live, settings, pairs, width); });
}

void match_near(const FrameView &reference, const FrameView &live, const Prediction &prediction,
                const MatchSettings &settings, std::vector<RowPair> &pairs) {
  with_width(live.width, [&](auto width) {
    match_near(reference, live, prediction, settings, pairs, width);
  });
}

} // namespace engram::ENGRAM_ISA
