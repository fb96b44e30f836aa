#include "kernels/word_tree.hpp"

#include <algorithm>
#include <bit>
#include <cstring>
#include <utility>

#include "kernels/bit_counts.hpp"
#include "kernels/width.hpp"

namespace engram::ENGRAM_ISA {
namespace {

constexpr int lanes = 8;
constexpr uint64_t none = ~uint64_t{0};

typedef Counts u64x8;

// Distance in the high half, number of the centre in the low one: the least key is the nearest
// centre, and of equally near ones the first.
template <class Width>
u64x8 keys_of(const Columns &centres, int64_t first, const uint64_t *descriptor, Width width) {
  const u64x8 distance =
      differing_bits(descriptor, &centres.words[first], centres.stride, width);
  const auto number = static_cast<uint64_t>(first);
  return (distance << 32) | (u64x8::numbers() + number);
}

// What of the eight lies below the end; the rest can never be the nearest.
u64x8 up_to(u64x8 keys, int64_t end) {
  return select((keys & 0xFFFFFFFF) < static_cast<uint64_t>(end), keys, none);
}

uint64_t least(u64x8 keys) {
  uint64_t best = none;
  for (int lane = 0; lane < lanes; ++lane)
    best = std::min(best, keys[lane]);
  return best;
}

// The nearest of the centres first up to end.
template <class Width>
uint64_t nearest(const Columns &centres, int64_t first, int64_t end, const uint64_t *descriptor,
                 Width width) {
  u64x8 best = u64x8(none);
  for (int64_t j = first; j < end; j += lanes)
    best = smaller(best, up_to(keys_of(centres, j, descriptor, width), end));
  return least(best);
}

// The `beam` nearest children of all nodes of a front, nearest first.
class Front {
public:
  explicit Front(int beam) : beam_(beam) {}

  void begin() {
    for (int place = 0; place < beam_; ++place)
      best_[place] = u64x8(none);
  }

  // Every lane keeps its own `beam` least keys, so that no branch depends on the data.
  template <class Width>
  void offer(const Columns &centres, int64_t first, int64_t end, const uint64_t *descriptor,
             Width width) {
    for (int64_t j = first; j < end; j += lanes)
      insert(up_to(keys_of(centres, j, descriptor, width), end));
  }

  void keep(uint64_t key) {
    u64x8 keys(none);
    keys[0] = key;
    insert(keys);
  }

  // The least keys of all lanes; returns how many there are.
  int finish(uint64_t *keys) const {
    int count = 0, taken[lanes] = {};
    for (; count < beam_; ++count) {
      int from = 0;
      uint64_t best = none;
      for (int lane = 0; lane < lanes; ++lane) {
        const uint64_t key = taken[lane] < beam_ ? best_[taken[lane]][lane] : none;
        if (key < best)
          best = key, from = lane;
      }
      if (best == none)
        break;
      ++taken[from];
      keys[count] = best;
    }
    return count;
  }

private:
  void insert(u64x8 keys) {
    for (int place = 0; place < beam_; ++place) {
      const u64x8 kept = smaller(best_[place], keys);
      keys = larger(best_[place], keys);
      best_[place] = kept;
    }
  }

  int beam_;
  u64x8 best_[kMaxBeam];
};

// Counts of the set bits of each column, bit-sliced: bit p of a count stands in plane p.
class BitCounts {
public:
  BitCounts(int64_t members, int width)
      : width_(static_cast<size_t>(width)),
        planes_(static_cast<size_t>(std::bit_width(static_cast<uint64_t>(members)))),
        bits_(width_ * planes_) {}

  void clear() { std::fill(bits_.begin(), bits_.end(), uint64_t{0}), members_ = 0; }

  void add(const uint64_t *descriptor) {
    ++members_;
    for (size_t word = 0; word < width_; ++word) {
      uint64_t carry = descriptor[word];
      for (uint64_t *plane = &bits_[word]; carry != 0; plane += width_) {
        const uint64_t next = *plane & carry;
        *plane ^= carry;
        carry = next;
      }
    }
  }

  int64_t members() const { return members_; }

  // Each bit as most of the members have it; a tie leaves it as it is.
  void majority(uint64_t *centre) const {
    const auto half = static_cast<uint64_t>(members_ / 2);
    for (size_t word = 0; word < width_; ++word) {
      uint64_t more = 0, equal = none;
      for (size_t plane = planes_; plane-- > 0;) {
        const uint64_t bits = bits_[width_ * plane + word];
        if (!((half >> plane) & 1))
          more |= equal & bits;
        equal &= (half >> plane) & 1 ? bits : ~bits;
      }
      const uint64_t tied = members_ % 2 == 0 ? equal : 0;
      centre[word] = more | (tied & centre[word]);
    }
  }

private:
  size_t width_, planes_;
  int64_t members_ = 0;
  std::vector<uint64_t> bits_;
};

// SplitMix64 (Steele, Lea & Flood, OOPSLA 2014).
uint64_t next_random(uint64_t &state) {
  uint64_t z = state += 0x9E3779B97F4A7C15;
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EB;
  return z ^ (z >> 31);
}

// 0 <= number < bound. The bias is below bound / 2^64.
uint64_t random_below(uint64_t &state, uint64_t bound) { return next_random(state) % bound; }

template <class Width> int hamming(const uint64_t *a, const uint64_t *b, Width width) {
  int bits = 0;
  for (int word = 0; word < width; ++word)
    bits += __builtin_popcountll(a[word] ^ b[word]);
  return bits;
}

// k-means++ (Arthur & Vassilvitskii, SODA 2007): members drawn with a probability proportional to
// their squared distance from the nearest centre so far; between binary vectors the Hamming
// distance is the squared Euclidean one. Fewer than k where the members are fewer or equal.
template <class Width>
int64_t draw_centres(const uint64_t *descriptors, int64_t count, int64_t k, uint64_t seed,
                     uint64_t *centres, Width width) {
  const auto beyond = static_cast<uint16_t>(64 * width + 1);
  std::vector<uint16_t> from_nearest(static_cast<size_t>(count), beyond);
  int64_t chosen = static_cast<int64_t>(random_below(seed, static_cast<uint64_t>(count)));
  for (int64_t j = 0; j < k; ++j) {
    const uint64_t *centre = descriptors + width * chosen;
    std::memcpy(centres + width * j, centre, sizeof(uint64_t) * width);
    uint64_t total = 0;
    for (int64_t i = 0; i < count; ++i) {
      uint16_t &nearest = from_nearest[static_cast<size_t>(i)];
      nearest = std::min(nearest, static_cast<uint16_t>(
                                      hamming(descriptors + width * i, centre, width)));
      total += nearest;
    }
    if (total == 0)
      return j + 1;
    uint64_t left = random_below(seed, total);
    for (chosen = 0; left >= from_nearest[static_cast<size_t>(chosen)]; ++chosen)
      left -= from_nearest[static_cast<size_t>(chosen)];
  }
  return k;
}

// Drops the centres without members; returns how many are left.
int64_t drop_empty(const std::vector<BitCounts> &clusters, uint64_t *centres, int64_t count,
                   int width, int32_t *assignment) {
  std::vector<int32_t> renumbered(clusters.size());
  int32_t left = 0;
  for (size_t j = 0; j < clusters.size(); ++j) {
    renumbered[j] = left;
    if (clusters[j].members() == 0)
      continue;
    std::memmove(centres + width * left, centres + width * static_cast<int64_t>(j),
                 sizeof(uint64_t) * static_cast<size_t>(width));
    ++left;
  }
  for (int64_t i = 0; i < count; ++i)
    assignment[i] = renumbered[static_cast<size_t>(assignment[i])];
  return left;
}

template <class Width>
void quantise(const WordTree &tree, const uint64_t *descriptors, int64_t count, int beam,
              int32_t *words, Width width) {
  const int32_t *bounds = tree.bounds.data();
  Front front(beam);
  for (int64_t i = 0; i < count; ++i) {
    const uint64_t *descriptor = descriptors + width * i;
    uint64_t keys[kMaxBeam] = {0};
    int ahead = 1;
    for (bool inner = true; inner;) {
      inner = false;
      front.begin();
      for (int place = 0; place < ahead; ++place) {
        const auto node = static_cast<int64_t>(keys[place] & 0xFFFFFFFF);
        if (bounds[node] == bounds[node + 1]) { // a leaf waits for the others
          front.keep(keys[place]);
          continue;
        }
        front.offer(tree.centres, bounds[node], bounds[node + 1], descriptor, width);
        inner = true;
      }
      if (inner)
        ahead = front.finish(keys);
    }
    words[i] = tree.words[static_cast<size_t>(keys[0] & 0xFFFFFFFF)];
  }
}

template <class Width>
int64_t k_majority(const uint64_t *descriptors, int64_t count, int64_t k, int iterations,
                   uint64_t seed, uint64_t *centres, int32_t *assignment, Width width) {
  k = draw_centres(descriptors, count, k, seed, centres, width);
  Columns columns(width, k);
  std::vector<BitCounts> clusters(static_cast<size_t>(k), BitCounts(count, width));
  std::fill(assignment, assignment + count, -1);
  for (int round = 0;; ++round) {
    columns.assign(centres, k);
    for (BitCounts &cluster : clusters)
      cluster.clear();
    bool changed = false;
    for (int64_t i = 0; i < count; ++i) {
      const uint64_t *descriptor = descriptors + width * i;
      const auto cluster =
          static_cast<int32_t>(nearest(columns, 0, k, descriptor, width) & 0xFFFFFFFF);
      changed |= assignment[i] != cluster;
      assignment[i] = cluster;
      clusters[static_cast<size_t>(cluster)].add(descriptor);
    }
    if (!changed || round == iterations)
      return drop_empty(clusters, centres, count, width, assignment);
    for (int64_t j = 0; j < k; ++j)
      if (clusters[static_cast<size_t>(j)].members() > 0)
        clusters[static_cast<size_t>(j)].majority(centres + width * j);
  }
}

} // namespace

void quantise(const WordTree &tree, const uint64_t *descriptors, int64_t count, int beam,
              int32_t *words) {
  with_width(tree.centres.width, [&](auto width) {
    quantise(tree, descriptors, count, beam, words, width);
  });
}

int64_t k_majority(const uint64_t *descriptors, int64_t count, int width, int64_t k, int iterations,
                   uint64_t seed, uint64_t *centres, int32_t *assignment) {
  return with_width(width, [&](auto words) {
    return k_majority(descriptors, count, k, iterations, seed, centres, assignment, words);
  });
}

} // namespace engram::ENGRAM_ISA
