#include "kernels/path_scores.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

namespace engram::ENGRAM_ISA {
namespace {

typedef double f64x8 __attribute__((vector_size(64)));
typedef int64_t i64x8 __attribute__((vector_size(64)));
typedef uint64_t u64x8 __attribute__((vector_size(64)));

constexpr int64_t lanes = 8;

// Rows of the first operand that are counted against one load of the second.
constexpr int64_t tile = 4;

// A product of many positive factors: mantissas in [1, 2) and exponents apart, eight lanes.
class Product {
public:
  void multiply(f64x8 factors) {
    value_ *= factors;
    // Factors stay below 2^33 (paths times observed nodes): 24 of them fit into a double.
    if (++pending_ == 24)
      normalise();
  }

  double log() {
    normalise();
    double mantissa = 1;
    int64_t exponent = 0;
    for (int lane = 0; lane < lanes; ++lane) {
      mantissa *= value_[lane];
      exponent += exponents_[lane];
    }
    return std::log(mantissa) + static_cast<double>(exponent) * 0.6931471805599453094;
  }

private:
  void normalise() {
    i64x8 bits = (i64x8)value_;
    exponents_ += (bits >> 52) - 1023;
    bits = (bits & 0x000FFFFFFFFFFFFF) | (static_cast<int64_t>(1023) << 52);
    value_ = (f64x8)bits;
    pending_ = 0;
  }

  f64x8 value_ = {1, 1, 1, 1, 1, 1, 1, 1};
  i64x8 exponents_ = {};
  int pending_ = 0;
};

u64x8 popcount(u64x8 words) {
  u64x8 counts;
  for (int lane = 0; lane < lanes; ++lane)
    counts[lane] = static_cast<uint64_t>(__builtin_popcountll(words[lane]));
  return counts;
}

// The bitsets of some nodes, eight nodes side by side: word w of group g stands at (g words + w).
struct Transposed {
  std::vector<u64x8> words;
  int64_t groups = 0;

  void gather(const PathBits &paths, const int32_t *nodes, int64_t count) {
    groups = (count + lanes - 1) / lanes;
    words.assign(static_cast<size_t>(groups * paths.words), u64x8{});
    auto *out = reinterpret_cast<uint64_t *>(words.data());
    for (int64_t j = 0; j < count; ++j) {
      const uint64_t *row = paths.bits + nodes[j] * paths.stride;
      for (int64_t w = 0; w < paths.words; ++w)
        out[((j / lanes) * paths.words + w) * lanes + j % lanes] = row[w];
    }
    if (paths.excluded >= 0)
      for (int64_t g = 0; g < groups; ++g)
        words[static_cast<size_t>(g * paths.words + paths.excluded / 64)] &=
            ~(uint64_t{1} << (paths.excluded % 64));
  }
};

// counts[r][g] for `rows` <= tile nodes against all groups.
void count_tile(const PathBits &paths, const int32_t *nodes, int64_t rows, const Transposed &other,
                u64x8 *const *counts) {
  const uint64_t *bits[tile];
  for (int64_t r = 0; r < tile; ++r)
    bits[r] = paths.bits + nodes[std::min(r, rows - 1)] * paths.stride;
  const u64x8 *column = other.words.data();
  for (int64_t g = 0; g < other.groups; ++g) {
    u64x8 sums[tile] = {};
    for (int64_t w = 0; w < paths.words; ++w, ++column)
      for (int64_t r = 0; r < tile; ++r)
        sums[r] += popcount(*column & bits[r][w]);
    for (int64_t r = 0; r < rows; ++r)
      counts[r][g] = sums[r];
  }
}

// Successes first: then one bound separates the two kinds of factor.
int64_t successes_first(const PathEvidence &evidence, std::vector<int32_t> &nodes) {
  nodes.clear();
  for (const uint8_t outcome : {1, 0})
    for (int64_t j = 0; j < evidence.observed_count; ++j)
      if ((evidence.outcomes[j] != 0) == (outcome != 0))
        nodes.push_back(evidence.observed[j]);
  return std::count_if(evidence.outcomes, evidence.outcomes + evidence.observed_count,
                       [](uint8_t outcome) { return outcome != 0; });
}

// log of the product over j of theta_ij where it succeeded, 1 - theta_ij where it failed:
// theta_ij = (Z_ij + alpha) / total, so the numerators multiply up and the total is taken out.
double log_likelihood(const u64x8 *counts, int64_t groups, int64_t count, int64_t successes,
                      double alpha) {
  u64x8 sums = {};
  for (int64_t g = 0; g < groups; ++g)
    sums += counts[g];
  uint64_t sum = 0;
  for (int lane = 0; lane < lanes; ++lane)
    sum += sums[lane];
  const double total = static_cast<double>(sum) + static_cast<double>(count) * alpha;
  Product product;
  for (int64_t g = 0; g < groups; ++g) {
    const f64x8 z = __builtin_convertvector((i64x8)counts[g], f64x8);
    f64x8 factors = lanes * (g + 1) <= successes ? z + alpha : (total - alpha) - z;
    const bool mixed = lanes * g < successes && lanes * (g + 1) > successes;
    if (mixed || lanes * (g + 1) > count)
      for (int64_t lane = 0; lane < lanes; ++lane) {
        const int64_t j = lanes * g + lane;
        factors[lane] = j >= count      ? 1
                        : j < successes ? z[lane] + alpha
                                        : (total - alpha) - z[lane];
      }
    product.multiply(factors);
  }
  return product.log() - static_cast<double>(count) * std::log(total);
}

} // namespace

void co_occurrence(const PathBits &paths, const int32_t *a, int64_t a_count, const int32_t *b,
                   int64_t b_count, int32_t *counts) {
  Transposed other;
  other.gather(paths, b, b_count);
  std::vector<u64x8> storage(static_cast<size_t>(tile * other.groups));
  u64x8 *rows[tile];
  for (int64_t r = 0; r < tile; ++r)
    rows[r] = storage.data() + r * other.groups;
  for (int64_t i = 0; i < a_count; i += tile) {
    const int64_t height = std::min(tile, a_count - i);
    count_tile(paths, a + i, height, other, rows);
    for (int64_t r = 0; r < height; ++r)
      for (int64_t j = 0; j < b_count; ++j)
        counts[(i + r) * b_count + j] = static_cast<int32_t>(rows[r][j / lanes][j % lanes]);
  }
}

void path_scores(const PathBits &paths, const int32_t *candidates, int64_t count,
                 const PathEvidence &evidence, double *scores) {
  std::vector<int32_t> observed;
  const int64_t successes = successes_first(evidence, observed);
  // theta over a single node is 1 whatever the counts: it says nothing.
  if (observed.size() == 1)
    observed.clear();
  const int64_t observed_count = static_cast<int64_t>(observed.size());
  Transposed columns, reference;
  columns.gather(paths, observed.data(), observed_count);
  const int32_t k = static_cast<int32_t>(evidence.reference);
  reference.gather(paths, &k, evidence.reference >= 0 ? 1 : 0);
  std::vector<u64x8> storage(static_cast<size_t>(tile * (columns.groups + 1)));
  u64x8 *rows[tile], *prior[tile];
  for (int64_t r = 0; r < tile; ++r) {
    rows[r] = storage.data() + r * columns.groups;
    prior[r] = storage.data() + tile * columns.groups + r;
  }
  for (int64_t i = 0; i < count; i += tile) {
    const int64_t height = std::min(tile, count - i);
    count_tile(paths, candidates + i, height, columns, rows);
    count_tile(paths, candidates + i, height, reference, prior);
    for (int64_t r = 0; r < height; ++r) {
      scores[i + r] = 0;
      if (reference.groups > 0)
        scores[i + r] += std::log(static_cast<double>((*prior[r])[0]) + evidence.gamma);
      if (observed_count > 0)
        scores[i + r] += log_likelihood(rows[r], columns.groups, observed_count, successes,
                                        evidence.alpha);
    }
  }
}

} // namespace engram::ENGRAM_ISA
