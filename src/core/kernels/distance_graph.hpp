// Which matches of two frames keep their distances from each other, as all right ones do.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/float_lanes.hpp"
#include "kernels/uncertainty.hpp"

namespace engram::ENGRAM_ISA {

// Place of the n-th set bit, counted from 0.
inline int nth_bit(uint64_t bits, int n) {
#ifdef __BMI2__
  return __builtin_ctzll(__builtin_ia32_pdep_di(uint64_t{1} << n, bits));
#else
  for (; n > 0; --n)
    bits &= bits - 1;
  return __builtin_ctzll(bits);
#endif
}

// Which pairs of matches keep their distance: |X_i − X_j| = |Y_i − Y_j| within what the depths
// allow. Wrong matches rarely do, so triples are drawn from this graph (Leordeanu & Hebert 2005;
// Chen et al., SC²-PCR, 2022), which leaves few hypotheses to score even at 90 % outliers.
class DistanceGraph {
public:
  DistanceGraph(const FrameView &reference, const FrameView &live,
                const std::vector<RowPair> &pairs, const MatchSettings &settings)
      : count_(static_cast<int>(pairs.size())), words_((count_ + 63) / 64),
        bits_(static_cast<size_t>(count_) * words_, 0), degrees_(count_) {
    Ends x(pairs.size()), y(pairs.size());
    for (const RowPair &pair : pairs) {
      x.add(reference, pair.reference, settings);
      y.add(live, pair.live, settings);
    }
    x.pad();
    y.pad();
    const auto gate2 = static_cast<float>(settings.gate_sigmas * settings.gate_sigmas);
    for (int i = 0; i < count_; ++i) {
      uint64_t *row = bits_.data() + static_cast<size_t>(i) * words_;
      for (int j = 0; j < count_; j += kLanes)
        row[j / 64] |= keep_distance(x, y, i, j, gate2) << (j % 64);
      row[i / 64] &= ~(uint64_t{1} << (i % 64));
      if (count_ % 64)
        row[words_ - 1] &= (uint64_t{1} << (count_ % 64)) - 1;
      degrees_[i] = popcount(row, row);
    }
  }

  // A pair of matches that keep their distance, and how many keep theirs from both.
  struct Edge {
    int i, j, common;
  };

  // Those with at least so many in common.
  std::vector<Edge> edges(int least) const {
    std::vector<Edge> result;
    result.reserve(static_cast<size_t>(4 * count_));
    for (int i = 0; i < count_; ++i) {
      if (degrees_[i] <= least) // the other end is none of what they have in common
        continue;
      for (int word = i / 64; word < words_; ++word) {
        uint64_t later = row(i)[word];
        if (word == i / 64)
          later &= ~uint64_t{0} << (i % 64);
        for (; later != 0; later &= later - 1) {
          const int j = 64 * word + __builtin_ctzll(later);
          const int common = degrees_[j] <= least ? 0 : popcount(row(i), row(j));
          if (common >= least)
            result.push_back({i, j, common});
        }
      }
    }
    return result;
  }

  // The n-th common neighbour of i and j, counted from 0.
  int nth_common(int i, int j, int n) const {
    for (int word = 0;; ++word) {
      const uint64_t bits = row(i)[word] & row(j)[word];
      const int here = __builtin_popcountll(bits);
      if (n < here)
        return 64 * word + nth_bit(bits, n);
      n -= here;
    }
  }

  // How many keep their distance from all three.
  int common(int i, int j, int k) const {
    int bits = 0;
    for (int word = 0; word < words_; ++word)
      bits += __builtin_popcountll(row(i)[word] & row(j)[word] & row(k)[word]);
    return bits;
  }

  // The chance that a triple drawn by `draw` consists of members only.
  double chance(const std::vector<uint64_t> &members) const {
    double total = 0;
    for (int i = 0; i < count_; ++i)
      if (members[i / 64] >> (i % 64) & 1) {
        const int all = degrees_[i];
        const double share =
            all > 0 ? static_cast<double>(popcount(row(i), members.data())) / all : 0;
        total += share * share;
      }
    return total / count_;
  }

  int words() const { return words_; }

private:
  // One side's landmarks. Depth errors move them along their rays, pixel errors across.
  struct Ends {
    std::vector<float> x, y, z, relative_variance, lateral_variance;

    explicit Ends(size_t wanted) {
      for (auto *values : {&x, &y, &z, &relative_variance, &lateral_variance})
        values->reserve(wanted + kLanes);
    }

    void add(const FrameView &frame, int32_t row, const MatchSettings &settings) {
      const float *point = frame.points_in_cam + 3 * row;
      const double lateral = pixel_sigma(frame, row, settings) * point[2] / frame.camera.fx;
      x.push_back(point[0]), y.push_back(point[1]), z.push_back(point[2]);
      relative_variance.push_back(static_cast<float>(
          relative_depth_variance(frame, row, settings, OffsetsAre::noise)));
      lateral_variance.push_back(static_cast<float>(lateral * lateral));
    }

    void pad() {
      const size_t padded = (x.size() + kLanes - 1) / kLanes * kLanes;
      for (auto *values : {&x, &y, &z, &relative_variance, &lateral_variance})
        values->resize(padded, 0);
    }
  };

  // Squared distance of landmark i to sixteen others, and its variance times that distance.
  static void distances(const Ends &ends, int i, int j, Floats &squared, Floats &spread) {
    const Floats x = load(&ends.x[j]), y = load(&ends.y[j]), z = load(&ends.z[j]);
    const Floats dx = ends.x[i] - x, dy = ends.y[i] - y, dz = ends.z[i] - z;
    squared = dx * dx + dy * dy + dz * dz;
    const Floats here = dx * ends.x[i] + dy * ends.y[i] + dz * ends.z[i];
    const Floats there = dx * x + dy * y + dz * z;
    spread = here * here * ends.relative_variance[i] +
             there * there * load(&ends.relative_variance[j]);
  }

  // Bit k says whether matches i and j + k keep their distance: with p, q the distances on either
  // side, (p − q)² ≤ g²σ². As (p² − q²)² ≤ g²σ² (p + q)² it needs no root, and (p + q)² is
  // 2 (p² + q²) where p ≈ q.
  static uint64_t keep_distance(const Ends &x, const Ends &y, int i, int j, float gate2) {
    Floats squared_x, squared_y, spread_x, spread_y;
    distances(x, i, j, squared_x, spread_x);
    distances(y, i, j, squared_y, spread_y);
    const Floats lateral = (x.lateral_variance[i] + y.lateral_variance[i]) +
                           load(&x.lateral_variance[j]) + load(&y.lateral_variance[j]);
    const Floats apart = squared_x - squared_y, both = squared_x + squared_y;
    const Ints keep =
        apart * apart <= gate2 * (4.0f * (spread_x + spread_y) + 2.0f * both * lateral);
    return bits_of(keep);
  }

  static int popcount_words(const uint64_t *a, const uint64_t *b, int words) {
    int bits = 0;
    for (int word = 0; word < words; ++word)
      bits += __builtin_popcountll(a[word] & b[word]);
    return bits;
  }
  int popcount(const uint64_t *a, const uint64_t *b) const { return popcount_words(a, b, words_); }
  const uint64_t *row(int i) const { return bits_.data() + static_cast<size_t>(i) * words_; }
  int count_, words_;
  std::vector<uint64_t> bits_;
  std::vector<int> degrees_;
};

} // namespace engram::ENGRAM_ISA
