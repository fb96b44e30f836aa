#include "kernels/path_scores.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

// How |Y| x |W| co-occurrence counts over thousands of paths fit into a fraction of a millisecond:
// a node is on few of all paths, so for a candidate only the rows of *its* paths are added up. A row
// says in one bit each which of 512 observed nodes are on the path; rows are added bit-sliced, 512
// counters at once, by carry-save adders (Harley-Seal). Most counts are small: those below 8 are
// tallied by value, mask by mask, and the others one by one.

namespace engram::ENGRAM_ISA {
namespace {

typedef uint64_t u64x8 __attribute__((vector_size(64)));

constexpr int64_t lanes = 8;
constexpr int64_t nodes_per_vector = 512;
constexpr int plane_count = 24; // counts below 2^24
constexpr uint64_t small_counts = 8;

u64x8 popcount(u64x8 x) {
#ifdef __AVX512VPOPCNTDQ__
  return (u64x8)__builtin_ia32_vpopcountq_v8di((long long __attribute__((vector_size(64))))x);
#else
  x -= (x >> 1) & 0x5555555555555555;
  x = (x & 0x3333333333333333) + ((x >> 2) & 0x3333333333333333);
  x = (x + (x >> 4)) & 0x0F0F0F0F0F0F0F0F;
  x += x >> 8;
  x += x >> 16;
  return (x + (x >> 32)) & 0x7F;
#endif
}

uint64_t sum_of(u64x8 x) {
  uint64_t sum = 0;
  for (int lane = 0; lane < lanes; ++lane)
    sum += x[lane];
  return sum;
}

bool any(u64x8 x) {
  return (x[0] | x[1] | x[2] | x[3] | x[4] | x[5] | x[6] | x[7]) != 0;
}

// Eight 64x64 bit matrices at once, one per lane: bit c of row r goes to bit r of row c.
void transpose(u64x8 *rows) {
  uint64_t mask = 0x00000000FFFFFFFF;
  for (int width = 32; width > 0; width >>= 1, mask ^= mask << width)
    for (int k = 0; k < 64; k = ((k | width) + 1) & ~width) {
      const u64x8 swapped = ((rows[k] >> width) ^ rows[k + width]) & mask;
      rows[k] ^= swapped << width;
      rows[k + width] ^= swapped;
    }
}

// Which of some nodes are on each path: bit j % 512 of row(j / 512, path).
class NodesByPath {
public:
  NodesByPath(const PathBits &paths, const int32_t *nodes, int64_t count)
      : vectors_((count + nodes_per_vector - 1) / nodes_per_vector), paths_(64 * paths.words),
        rows_(static_cast<size_t>(vectors_ * paths_ + 1)) {
    for (int64_t v = 0; v < vectors_; ++v)
      for (int64_t w = 0; w < paths.words; ++w) {
        u64x8 *block = rows_.data() + v * paths_ + 64 * w;
        for (int64_t r = 0; r < 64; ++r)
          for (int64_t lane = 0; lane < lanes; ++lane) {
            const int64_t j = v * nodes_per_vector + 64 * lane + r;
            block[r][lane] = j < count ? paths.bits[nodes[j] * paths.stride + w] : 0;
          }
        transpose(block);
      }
    if (paths.excluded >= 0)
      for (int64_t v = 0; v < vectors_; ++v)
        rows_[static_cast<size_t>(v * paths_ + paths.excluded)] = u64x8{};
  }

  int64_t vectors() const { return vectors_; }
  const u64x8 *rows(int64_t vector) const { return rows_.data() + vector * paths_; }
  // A row of nothing, for padding.
  const u64x8 *empty() const { return rows_.data() + vectors_ * paths_; }

private:
  int64_t vectors_, paths_;
  std::vector<u64x8> rows_;
};

// The numbers of a node's paths.
void list_paths(const PathBits &paths, int32_t node, std::vector<int32_t> &list) {
  list.clear();
  const uint64_t *row = paths.bits + node * paths.stride;
  for (int64_t w = 0; w < paths.words; ++w)
    for (uint64_t rest = row[w]; rest != 0; rest &= rest - 1)
      list.push_back(static_cast<int32_t>(64 * w + __builtin_ctzll(rest)));
}

// 512 counters, bit-sliced: bit l of a counter stands in plane l.
struct Counters {
  u64x8 planes[plane_count] = {};
  int used = 3;

  // Sum and carry of three bits per counter.
  static u64x8 add(u64x8 &sum, u64x8 b, u64x8 c) {
    const u64x8 half = sum ^ b;
    const u64x8 carry = (sum & b) | (half & c);
    sum = half ^ c;
    return carry;
  }

  void add_eight(const u64x8 *const *rows) {
    u64x8 fours[2];
    for (int half = 0; half < 2; ++half) {
      const u64x8 *const *four = rows + 4 * half;
      const u64x8 first = add(planes[0], *four[0], *four[1]);
      const u64x8 second = add(planes[0], *four[2], *four[3]);
      fours[half] = add(planes[1], first, second);
    }
    u64x8 carry = add(planes[2], fours[0], fours[1]);
    for (int level = 3; level < plane_count && any(carry); ++level) {
      const u64x8 next = planes[level] & carry;
      planes[level] ^= carry;
      carry = next;
      used = std::max(used, level + 1);
    }
  }

  void add_paths(const std::vector<int32_t> &list, const u64x8 *rows, const u64x8 *empty) {
    const size_t count = list.size();
    for (size_t i = 0; i < count; i += 8) {
      const u64x8 *eight[8];
      for (size_t k = 0; k < 8; ++k)
        eight[k] = i + k < count ? rows + list[i + k] : empty;
      add_eight(eight);
    }
  }

  u64x8 large() const {
    u64x8 mask = {};
    for (int level = 3; level < used; ++level)
      mask |= planes[level];
    return mask;
  }

  // The counters that hold a small count.
  u64x8 equal_to(uint64_t count) const {
    u64x8 mask = ~large();
    for (int level = 0; level < 3; ++level)
      mask &= (count >> level) & 1 ? planes[level] : ~planes[level];
    return mask;
  }

  uint64_t at(int64_t word, int bit) const {
    uint64_t count = 0;
    for (int level = 0; level < used; ++level)
      count |= ((planes[level][word] >> bit) & 1) << level;
    return count;
  }

  template <class Visit> void each(u64x8 mask, const Visit &visit) const {
    for (int64_t word = 0; word < lanes; ++word)
      for (uint64_t rest = mask[word]; rest != 0; rest &= rest - 1)
        visit(64 * word + __builtin_ctzll(rest), at(word, __builtin_ctzll(rest)));
  }
};

// A product of many positive factors that neither overflows nor underflows.
class Product {
public:
  void multiply(double factor) {
    value_ *= factor;
    if (value_ > 0x1p900 || value_ < 0x1p-900) {
      int exponent = 0;
      value_ = std::frexp(value_, &exponent);
      exponent_ += exponent;
    }
  }
  double log() const {
    return std::log(value_) + static_cast<double>(exponent_) * 0.6931471805599453094;
  }

private:
  double value_ = 1;
  int64_t exponent_ = 0;
};

// The counts of one candidate against all observed nodes, tallied.
struct Tally {
  u64x8 small_successes[small_counts] = {}, small_failures[small_counts] = {};
  std::vector<uint64_t> large_successes, large_failures;

  void clear() {
    std::fill_n(small_successes, small_counts, u64x8{});
    std::fill_n(small_failures, small_counts, u64x8{});
    large_successes.clear();
    large_failures.clear();
  }

  void count(const Counters &counters, u64x8 successes, u64x8 failures) {
    for (uint64_t value = 0; value < small_counts; ++value) {
      const u64x8 equal = counters.equal_to(value);
      small_successes[value] += popcount(equal & successes);
      small_failures[value] += popcount(equal & failures);
    }
    const u64x8 large = counters.large();
    counters.each(large & successes, [&](int64_t, uint64_t z) { large_successes.push_back(z); });
    counters.each(large & failures, [&](int64_t, uint64_t z) { large_failures.push_back(z); });
  }

  // log of the product over j of theta_ij where it succeeded, 1 - theta_ij where it failed:
  // theta_ij = (Z_ij + alpha) / total, so the numerators multiply up and the total is taken out.
  double log_likelihood(double observed, double alpha) const {
    uint64_t all = 0;
    for (uint64_t value = 1; value < small_counts; ++value)
      all += value * sum_of(small_successes[value] + small_failures[value]);
    for (const std::vector<uint64_t> *large : {&large_successes, &large_failures})
      for (const uint64_t value : *large)
        all += value;
    const double total = static_cast<double>(all) + observed * alpha;
    double score = -observed * std::log(total);
    for (uint64_t value = 0; value < small_counts; ++value) {
      const double z = static_cast<double>(value);
      if (const uint64_t times = sum_of(small_successes[value]))
        score += static_cast<double>(times) * std::log(z + alpha);
      if (const uint64_t times = sum_of(small_failures[value]))
        score += static_cast<double>(times) * std::log((total - alpha) - z);
    }
    Product product;
    for (const uint64_t z : large_successes)
      product.multiply(static_cast<double>(z) + alpha);
    for (const uint64_t z : large_failures)
      product.multiply((total - alpha) - static_cast<double>(z));
    return score + product.log();
  }
};

// One bit per observed node: whether it succeeded, and whether it failed.
void outcome_masks(const PathEvidence &evidence, std::vector<u64x8> &successes,
                   std::vector<u64x8> &failures) {
  for (int64_t j = 0; j < evidence.observed_count; ++j) {
    std::vector<u64x8> &masks = evidence.outcomes[j] != 0 ? successes : failures;
    masks[static_cast<size_t>(j / nodes_per_vector)][(j % nodes_per_vector) / 64] |=
        uint64_t{1} << (j % 64);
  }
}

// Number of paths that hold both nodes.
uint64_t shared_paths(const PathBits &paths, int32_t a, int32_t b) {
  const uint64_t *first = paths.bits + a * paths.stride, *second = paths.bits + b * paths.stride;
  uint64_t count = 0;
  for (int64_t w = 0; w < paths.words; ++w)
    count += static_cast<uint64_t>(__builtin_popcountll(first[w] & second[w]));
  if (paths.excluded >= 0)
    count -= (first[paths.excluded / 64] & second[paths.excluded / 64]) >>
                 (paths.excluded % 64) &
             1;
  return count;
}

} // namespace

void co_occurrence(const PathBits &paths, const int32_t *a, int64_t a_count, const int32_t *b,
                   int64_t b_count, int32_t *counts) {
  const NodesByPath others(paths, b, b_count);
  std::vector<int32_t> list;
  std::fill_n(counts, a_count * b_count, 0);
  for (int64_t i = 0; i < a_count; ++i) {
    list_paths(paths, a[i], list);
    for (int64_t v = 0; v < others.vectors(); ++v) {
      Counters counters;
      counters.add_paths(list, others.rows(v), others.empty());
      int32_t *row = counts + i * b_count + v * nodes_per_vector;
      counters.each(~counters.equal_to(0), [&](int64_t j, uint64_t count) {
        row[j] = static_cast<int32_t>(count);
      });
    }
  }
}

void path_scores(const PathBits &paths, const int32_t *candidates, int64_t count,
                 const PathEvidence &evidence, double *scores) {
  // theta over a single node is 1 whatever the counts: it says nothing.
  const int64_t observed = evidence.observed_count > 1 ? evidence.observed_count : 0;
  const NodesByPath others(paths, evidence.observed, observed);
  std::vector<u64x8> successes(static_cast<size_t>(others.vectors())),
      failures(static_cast<size_t>(others.vectors()));
  if (observed > 0)
    outcome_masks(evidence, successes, failures);
  std::vector<int32_t> list;
  Tally tally;
  for (int64_t i = 0; i < count; ++i) {
    scores[i] = 0;
    if (evidence.reference >= 0) {
      const auto reference = static_cast<int32_t>(evidence.reference);
      const auto shared = static_cast<double>(shared_paths(paths, candidates[i], reference));
      scores[i] += std::log(shared + evidence.gamma);
    }
    if (observed == 0)
      continue;
    list_paths(paths, candidates[i], list);
    tally.clear();
    for (int64_t v = 0; v < others.vectors(); ++v) {
      Counters counters;
      counters.add_paths(list, others.rows(v), others.empty());
      tally.count(counters, successes[static_cast<size_t>(v)], failures[static_cast<size_t>(v)]);
    }
    scores[i] += tally.log_likelihood(static_cast<double>(observed), evidence.alpha);
  }
}

} // namespace engram::ENGRAM_ISA
