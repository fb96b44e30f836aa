#include "kernels/matching.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "kernels/bit_counts.hpp"
#include "kernels/buffer.hpp"
#include "kernels/double_lanes.hpp"
#include "kernels/float_lanes.hpp"
#include "kernels/projection.hpp"
#include "kernels/rigid.hpp"
#include "kernels/width.hpp"

namespace engram::ENGRAM_ISA {
namespace {

constexpr int64_t kColumns = 32; // lanes of Shorts
constexpr int16_t kFar = 32767;

// A descriptor, wherever it stands in memory, as words that may be loaded.
template <class Width> struct Descriptor {
  uint64_t words[most_words(Width{})];

  Descriptor(const uint64_t *from, Width width) {
    std::memcpy(words, from, sizeof(uint64_t) * width);
  }
};

// Asks for memory that is read soon, and not from front to back.
template <class T> void fetch(const T *values, int64_t count) {
  constexpr int64_t kLine = 64;
  const auto *bytes = reinterpret_cast<const char *>(values);
  for (int64_t at = 0; at < count * static_cast<int64_t>(sizeof(T)); at += kLine)
    __builtin_prefetch(bytes + at);
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
  fetch(frame.descriptors, width * frame.count);
  fetch(frame.pixels, 2 * frame.count);
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
  Counts totals[4];
  for (int group = 0; group < 4; ++group)
    totals[group] = differing_bits(descriptor, block + 8 * group, kColumns, width);
  return ((totals[0] | totals[1] << 16) | (totals[2] | totals[3] << 16) << 32).as<Shorts>();
}

int16_t least_of(const Shorts &lanes) {
  const auto least_of_two = [](auto a, auto b) { return a < b ? a : b; };
  const auto quarter =
      least_of_two(least_of_two(quarter_of<0>(lanes), quarter_of<2>(lanes)),
                   least_of_two(quarter_of<1>(lanes), quarter_of<3>(lanes)));
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
      : blocks_(blocks), here_(blocks.count()), nearest_(blocks.count(), Shorts(kFar)),
        nearest_row_(blocks.count(), Shorts(-1)) {}

  // Returns the least distance to a column that this landmark is the nearest one to so far, which
  // it has to be of its own nearest column; kFar if that is beyond `limit`. Out of line, so that
  // the descriptor stays in registers over all blocks.
  //
  // Of landmarks equally near, a column's is the first by its row; `in_order` if no later one was
  // measured before.
  template <bool in_order, class Width>
  [[gnu::noinline]] int16_t measure(const uint64_t *descriptor, int16_t row, double least_m,
                                    double most_m, int16_t limit, Width width) {
    // Sizes rise from block to block, but for those within a bucket.
    begin_ = 0, end_ = blocks_.count();
    while (begin_ < end_ && blocks_.most_m[begin_] < least_m)
      ++begin_;
    while (begin_ < end_ && blocks_.least_m[end_ - 1] > most_m)
      --end_;
    Shorts claimed(kFar);
    for (int64_t block = begin_; block < end_; ++block) {
      if (blocks_.most_m[block] < least_m || blocks_.least_m[block] > most_m) {
        here_[block] = Shorts(kFar);
        continue;
      }
      Shorts here = distances_to(descriptor, &blocks_.words[block * width * kColumns], width);
      if (block == blocks_.count() - 1)
        here |= blocks_.beyond;
      const Shorts before = nearest_[block];
      Shorts closer = here < before;
      if constexpr (!in_order)
        closer |= (here == before) & (Shorts(row) < nearest_row_[block]);
      claimed = smaller(select(closer, here, Shorts(kFar)), claimed);
      here_[block] = here;
      nearest_[block] = select(closer, here, before);
      nearest_row_[block] = select(closer, Shorts(row), nearest_row_[block]);
    }
    return bits_of(claimed <= limit) != 0 ? least_of(claimed) : kFar;
  }

  // Calls visit(column, distance) for those measured last within the limit, until it returns false.
  template <class Visit> void within(int16_t limit, Visit visit) const {
    for (int64_t block = begin_; block < end_; ++block)
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
  int64_t begin_ = 0, end_ = 0; // blocks measured last
};

bool apart(const Blocks &blocks, int32_t a, int32_t b, double limit_px) {
  return std::abs(blocks.u[a] - blocks.u[b]) > limit_px ||
         std::abs(blocks.v[a] - blocks.v[b]) > limit_px;
}

// The first column at the smallest distance, or -1 where that is less than `least`, or another
// corner is nearly as close. The same corner found in a second octave is no rival.
int32_t distinct_column(const Distances &distances, int16_t least, const MatchSettings &settings,
                        const Blocks &blocks, std::vector<int32_t> &close) {
  const auto limit = static_cast<int16_t>(std::min(least / settings.ratio, 64.0 * blocks.width));
  close.clear();
  int32_t best = -1;
  distances.within(limit, [&](int32_t column, int16_t distance) {
    if (distance < least) {
      best = -1;
      close.clear();
      return false;
    }
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

Floats magnitude(const Floats &lanes) { return (lanes.as<Ints>() & 0x7fffffff).as<Floats>(); }

// Memory of Strips and match_near, used again by every call.
struct Scratch {
  Buffer<float> places;
  Buffer<int32_t> starts, rows, nearest, candidates;
  Buffer<uint64_t> words;
};

// Landmarks of a frame in strips across its image, from top to bottom, in blocks of sixteen. A
// window is as wide as the prediction is vague, up to most of the image, so that sixteen landmarks
// are tested at once. Rows of landmarks are counted in 16 bits.
template <class Width> class Strips {
public:
  Strips(const FrameView &frame, double gate_sigmas, Width width, Scratch &scratch)
      : width_(width), count_(frame.count), padded_((frame.count + kLanes - 1) / kLanes * kLanes) {
    for (int64_t row = 0; row < count_; ++row) {
      right_ = std::max(right_, frame.pixels[2 * row]);
      bottom_ = std::max(bottom_, frame.pixels[2 * row + 1]);
    }
    strips_ = static_cast<int>(std::min(bottom_, kExtent) / kHeight) + 1;
    sort(frame, scratch);
    float *places = scratch.places.room_for(4 * padded_);
    u_ = places, v_ = places + padded_, disparity_ = v_ + padded_, reach_ = disparity_ + padded_;
    std::fill(places, places + 4 * padded_, kNowhere);
    words_ = scratch.words.room_for(width * padded_);
    for (int64_t place = 0; place < count_; ++place) {
      const int32_t row = rows_[place];
      u_[place] = frame.pixels[2 * row], v_[place] = frame.pixels[2 * row + 1];
      disparity_[place] = frame.disparity_px[row];
      reach_[place] = static_cast<float>(gate_sigmas * frame.disparity_sigma_px[row]);
      uint64_t *words = words_of(place / kLanes) + 8 * (place % 2) + place % kLanes / 2;
      for (int word = 0; word < width; ++word)
        std::memcpy(words + kLanes * word, frame.descriptors + width * row + word,
                    sizeof(uint64_t));
    }
    nearest_ = scratch.nearest.room_for(2 * padded_);
    std::fill(nearest_, nearest_ + padded_, kFar);
    std::fill(nearest_ + padded_, nearest_ + 2 * padded_, -1);
    candidates_ = scratch.candidates.room_for(padded_ + padded_ / kLanes);
  }

  // Whether a place is closer than the margin to the image's landmarks.
  bool within(double u, double v, double margin) const {
    return u >= -margin && v >= -margin && u <= right_ + margin && v <= bottom_ + margin;
  }

  // Compares a descriptor of reference landmark `row` with the landmarks whose (u, v, disparity)
  // lie within the radius; that of the disparity is widened by their own doubt. Returns the least
  // distance · 2¹⁶ + row, or kNone.
  int32_t compare(const std::array<float, 3> &centre, const std::array<float, 3> &radius,
                  const uint64_t *descriptor, int32_t row) {
    const int32_t begin = starts_[strip(centre[1] - radius[1])];
    const int32_t end = starts_[strip(centre[1] + radius[1]) + 1];
    Ints best(kNone);
    compared_ = 0;
    for (int32_t k = begin / kLanes * kLanes; k < end; k += kLanes) {
      const Ints place = Ints::numbers() + k;
      // A block may reach into the strips above and below, which are too far away.
      const Ints near = (magnitude(load(&u_[k]) - centre[0]) <= radius[0]) &
                        (magnitude(load(&v_[k]) - centre[1]) <= radius[1]) &
                        (magnitude(load(&disparity_[k]) - centre[2]) <=
                         radius[2] + load(&reach_[k])) &
                        (place >= begin) & (place < end);
      if (bits_of(near) == 0)
        continue;
      const uint64_t *words = words_of(k / kLanes);
      const Counts even = differing_bits(descriptor, words, kLanes, width_);
      const Counts odd = differing_bits(descriptor, words + 8, kLanes, width_);
      const Ints distance = (even | odd << 32).as<Ints>();
      const Ints before = load(nearest_ + k), closer = near & (distance < before);
      select(closer, distance, before).store(nearest_ + k);
      select(closer, Ints(row), load(nearest_ + padded_ + k)).store(nearest_ + padded_ + k);
      const Ints key = select(near, distance << 16 | load(rows_ + k), kNone);
      best = smaller(key, best);
      key.store(candidates_ + kLanes * compared_);
      candidates_[padded_ + compared_++] = k;
    }
    return least_of(best);
  }

  // Whether all that were compared last at a distance up to the limit lie at one corner.
  bool at_one_corner(int32_t limit, const float *corner, double within_px) const {
    for (int32_t block = 0; block < compared_; ++block) {
      const int32_t *keys = candidates_ + kLanes * block;
      const float *u = u_ + candidates_[padded_ + block], *v = v_ + candidates_[padded_ + block];
      for (uint32_t bits = bits_of(load(keys) < ((limit + 1) << 16)); bits != 0; bits &= bits - 1)
        if (const int lane = __builtin_ctz(bits); std::abs(u[lane] - corner[0]) > within_px ||
                                                  std::abs(v[lane] - corner[1]) > within_px)
          return false;
    }
    return true;
  }

  // Of each landmark the reference landmark nearest to it, by its row in the frame; −1 for none.
  void nearest_rows(std::vector<int32_t> &rows) const {
    rows.resize(count_);
    for (int64_t place = 0; place < count_; ++place)
      rows[rows_[place]] = nearest_[padded_ + place];
  }

  static constexpr int32_t kNone = 0x7fffffff;

private:
  static constexpr float kHeight = 8;
  static constexpr float kExtent = 16384;
  static constexpr float kNowhere = 1e30f; // in the padding

  // By strip, in a strip by row.
  void sort(const FrameView &frame, Scratch &scratch) {
    starts_ = scratch.starts.room_for(2 * strips_ + 1);
    int32_t *next = starts_ + strips_ + 1;
    rows_ = scratch.rows.room_for(padded_);
    std::fill(starts_, starts_ + strips_ + 1, 0);
    for (int64_t row = 0; row < count_; ++row)
      ++starts_[strip(frame.pixels[2 * row + 1]) + 1];
    for (int k = 0; k < strips_; ++k)
      starts_[k + 1] += starts_[k];
    std::copy(starts_, starts_ + strips_, next);
    for (int64_t row = 0; row < count_; ++row)
      rows_[next[strip(frame.pixels[2 * row + 1])]++] = static_cast<int32_t>(row);
    std::fill(rows_ + count_, rows_ + padded_, 0);
  }

  // Of a block's descriptors: word w of place 2 i + odd stands at 16 w + 8 odd + i, so that two
  // vectors of counts in 64 bits shift into one of 32 bits.
  uint64_t *words_of(int64_t block) const { return words_ + block * width_ * kLanes; }

  static int32_t least_of(const Ints &lanes) {
    const auto least_of_two = [](auto a, auto b) { return a < b ? a : b; };
    const auto four = least_of_two(least_of_two(quarter_of<0>(lanes), quarter_of<2>(lanes)),
                                   least_of_two(quarter_of<1>(lanes), quarter_of<3>(lanes)));
    return std::min(std::min(four[0], four[1]), std::min(four[2], four[3]));
  }

  int strip(float v) const {
    const float number = v / kHeight;
    return number >= static_cast<float>(strips_ - 1) ? strips_ - 1
           : number > 0                              ? static_cast<int>(number)
                                                     : 0;
  }

  Width width_;
  int64_t count_, padded_;
  float right_ = 0, bottom_ = 0;
  int strips_, compared_ = 0;
  int32_t *starts_, *rows_;
  float *u_, *v_, *disparity_, *reach_;
  uint64_t *words_;
  int32_t *nearest_;    // distance by place, then row of the reference by place
  int32_t *candidates_; // keys of the blocks compared last, then their first places
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
    const Doubles iz = 1.0 / select(result.worth, seen[2], 1.0);
    const Doubles along_u = live_.fx * iz, along_v = live_.fy * iz, d = along_u * live_.baseline_m;
    result.stereo = {along_u * seen[0] + live_.cx, along_v * seen[1] + live_.cy, d};
    // By the point, in the live camera; then by the pose, and by the depth along the ray.
    const Doubles zero(0);
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
      const Doubles radius =
          settings_.gate_sigmas * square_root(select(variance < 0.0, Doubles(0), variance));
      // So that what is no number becomes the bound.
      result.radius[k] = select(radius < settings_.max_radius_px, radius, settings_.max_radius_px);
    }
    return result;
  }

  Doubles variance_along(const std::array<Doubles, 6> &row) const {
    Doubles total(0);
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

// Compares landmarks of a reference with all of a live frame, some at a time.
template <class Width> class WholeSearch {
public:
  WholeSearch(const FrameView &reference, const FrameView &live, const MatchSettings &settings,
              Width width)
      : reference_(reference), settings_(settings), width_(width),
        blocks_(blocks_of(live, settings, width)), distances_(blocks_) {
    forward_.reserve(reference.count);
  }

  // Every `step`-th landmark of the reference, from `first` on; `in_order` if none that comes
  // later in it has been compared.
  template <bool in_order> void compare(int64_t first, int64_t step) {
    if (first == 0)
      fetch(reference_.descriptors, width_ * reference_.count);
    const auto limit = static_cast<int16_t>(std::min<int32_t>(settings_.max_distance, kFar - 1));
    for (int64_t i = first; i < reference_.count; i += step) {
      const Patch patch = patch_of(reference_, i, settings_);
      const double reach = settings_.patch_ratio * patch.doubt * patch.doubt;
      const Descriptor<Width> descriptor(reference_.descriptors + width_ * i, width_);
      const int16_t least =
          distances_.template measure<in_order>(descriptor.words, static_cast<int16_t>(i),
                                                patch.size_m / reach, patch.size_m * reach, limit,
                                                width_);
      if (least == kFar)
        continue;
      const int32_t column = distinct_column(distances_, least, settings_, blocks_, close_);
      if (column >= 0)
        forward_.push_back({static_cast<int32_t>(i), column, least});
    }
  }

  // Of those compared, the pairs that are each other's nearest, in the order of comparison.
  void mutual(std::vector<RowPair> &pairs) const {
    pairs.clear();
    for (const RowPair &pair : forward_)
      if (distances_.nearest_row(pair.live) == pair.reference)
        pairs.push_back({pair.reference, blocks_.rows[pair.live], pair.distance});
  }

private:
  const FrameView &reference_;
  const MatchSettings &settings_;
  Width width_;
  Blocks blocks_;
  Distances distances_;
  std::vector<RowPair> forward_; // `live` is a column
  std::vector<int32_t> close_;
};

template <class Width>
bool match_all(const FrameView &reference, const FrameView &live, const MatchSettings &settings,
               std::vector<RowPair> &pairs, const Glance *glance, Width width) {
  pairs.clear();
  if (reference.count == 0 || live.count == 0)
    return false;
  WholeSearch<Width> search(reference, live, settings, width);
  const int64_t parts = glance == nullptr ? 1 : settings.glance_share;
  search.template compare<true>(0, parts);
  if (parts > 1) {
    search.mutual(pairs);
    if (glance->suffices(glance->state, pairs))
      return true;
    for (int64_t first = 1; first < parts; ++first)
      search.template compare<false>(first, parts);
  }
  search.mutual(pairs);
  if (parts > 1)
    std::sort(pairs.begin(), pairs.end(),
              [](const RowPair &a, const RowPair &b) { return a.reference < b.reference; });
  return false;
}

// The greatest distance of a rival: distance · ratio ≤ least.
int32_t greatest_rival(int32_t least, double ratio) {
  auto rival = static_cast<int32_t>(least / ratio) + 1;
  while (rival * ratio > least)
    --rival;
  return rival;
}

template <class Width>
void match_near(const FrameView &reference, const FrameView &live, const Prediction &prediction,
                const MatchSettings &settings, std::vector<RowPair> &pairs, Width width) {
  pairs.clear();
  if (reference.count == 0 || live.count == 0)
    return;
  static thread_local Scratch scratch;
  Strips<Width> strips(live, settings.gate_sigmas, width, scratch);
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
    const auto row = static_cast<int32_t>(i);
    const int32_t key = strips.compare(centre, radius, descriptor.words, row);
    const int32_t least = key >> 16, best = key & 0xffff;
    if (key == strips.kNone || least > settings.max_guided_distance)
      continue;
    if (strips.at_one_corner(greatest_rival(least, settings.guided_ratio), live.pixels + 2 * best,
                             settings.same_corner_px))
      pairs.push_back({row, best, least});
  }
  static thread_local std::vector<int32_t> nearest_row;
  strips.nearest_rows(nearest_row);
  std::erase_if(pairs, [&](const RowPair &p) { return nearest_row[p.live] != p.reference; });
}

} // namespace

bool match_all(const FrameView &reference, const FrameView &live, const MatchSettings &settings,
               std::vector<RowPair> &pairs, const Glance *glance) {
  bool sufficed = false;
  with_width(live.width, [&](auto width) {
    sufficed = match_all(reference, live, settings, pairs, glance, width);
  });
  return sufficed;
}

void match_near(const FrameView &reference, const FrameView &live, const Prediction &prediction,
                const MatchSettings &settings, std::vector<RowPair> &pairs) {
  with_width(live.width, [&](auto width) {
    match_near(reference, live, prediction, settings, pairs, width);
  });
}

} // namespace engram::ENGRAM_ISA
