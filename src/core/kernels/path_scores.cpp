#include "kernels/path_scores.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels/bit_counts.hpp"

// How |Y| x |W| co-occurrence counts over thousands of paths fit into a fraction of a millisecond:
// a node is on few of all paths, so for a candidate only the rows of *its* paths are added up. A row
// says in one bit each which of 512 observed nodes are on the path; rows are added bit-sliced, 512
// counters at once, by carry-save adders (Harley-Seal). The counts are tallied by value: which
// counters hold it is a mask, and how many, its popcount.

namespace engram::ENGRAM_ISA {
namespace {

typedef Counts u64x8;

constexpr int64_t lanes = 8;
constexpr int64_t nodes_per_vector = 512;
constexpr int plane_count = 24; // counts below 2^24
constexpr int64_t octet = 8;    // values whose masks share all planes but the lowest three

bool any(const u64x8 &x) {
#ifdef __AVX512BW__
  return _mm512_test_epi64_mask((__m512i)x.part[0], (__m512i)x.part[0]) != 0;
#else
  uint64_t bits = 0;
  for (int lane = 0; lane < lanes; ++lane)
    bits |= x[lane];
  return bits != 0;
#endif
}

uint64_t sum_of(const u64x8 &x) {
  uint64_t total = 0;
  for (int lane = 0; lane < lanes; ++lane)
    total += x[lane];
  return total;
}

// Swaps the off-diagonal blocks of the 2 width x 2 width blocks that two rows are part of.
template <int width> void swap_blocks(u64x8 &above, u64x8 &below, uint64_t mask) {
  const u64x8 swapped = ((above >> width) ^ below) & mask;
  above ^= swapped << width;
  below ^= swapped;
}

// Three rounds of it among eight rows a stride apart, which stay in registers meanwhile.
template <int stride>
void swap_blocks_of_eight(u64x8 *rows, uint64_t widest, uint64_t middle, uint64_t narrowest) {
  u64x8 row[8];
  for (int k = 0; k < 8; ++k)
    row[k] = rows[k * stride];
  for (int k = 0; k < 4; ++k)
    swap_blocks<4 * stride>(row[k], row[k + 4], widest);
  for (const int k : {0, 1, 4, 5})
    swap_blocks<2 * stride>(row[k], row[k + 2], middle);
  for (int k = 0; k < 8; k += 2)
    swap_blocks<stride>(row[k], row[k + 1], narrowest);
  for (int k = 0; k < 8; ++k)
    rows[k * stride] = row[k];
}

// Eight 64x64 bit matrices at once, one per lane: bit c of row r goes to bit r of row c.
void transpose(u64x8 *rows) {
  for (int k = 0; k < 8; ++k)
    swap_blocks_of_eight<8>(rows + k, 0x00000000FFFFFFFF, 0x0000FFFF0000FFFF, 0x00FF00FF00FF00FF);
  for (int k = 0; k < 64; k += 8)
    swap_blocks_of_eight<1>(rows + k, 0x0F0F0F0F0F0F0F0F, 0x3333333333333333, 0x5555555555555555);
}

// Lane g of row l goes to lane l of row g.
void transpose_words(const u64x8 *in, int64_t in_step, u64x8 *out, int64_t out_step) {
  for (int64_t g = 0; g < lanes; ++g) {
    uint64_t row[lanes];
    for (int64_t l = 0; l < lanes; ++l)
      row[l] = in[l * in_step][static_cast<int>(g)];
    out[g * out_step] = u64x8::load(row);
  }
}

u64x8 *rows_of(ObservedPaths &known) {
  const auto first = reinterpret_cast<uintptr_t>(known.storage.data());
  return reinterpret_cast<u64x8 *>((first + 63) / 64 * 64);
}

// Which of some nodes are on each path: bit slot % 512 of row(slot / 512, path).
class NodesByPath {
public:
  // What is known of other nodes is taken over where few of them are new.
  NodesByPath(const PathBits &paths, ObservedPaths &known, const int32_t *nodes, int64_t count)
      : paths_(paths), known_(known), slots_(static_cast<size_t>(count)) {
    const int64_t padded = (paths.words + lanes - 1) / lanes * lanes * 64;
    const int64_t vectors = (count + nodes_per_vector - 1) / nodes_per_vector;
    known_.slot_of.resize(static_cast<size_t>(paths.rows), -1);
    if (known_.paths != padded || known_.vectors != vectors || !update(nodes, count))
      build(nodes, count, vectors, padded);
  }

  int64_t vectors() const { return known_.vectors; }
  const u64x8 *rows(int64_t vector) const { return start() + vector * known_.paths; }
  // A row of nothing, for padding.
  const u64x8 *empty() const { return start() + known_.vectors * known_.paths; }
  int64_t slot(int64_t j) const { return slots_[static_cast<size_t>(j)]; }

private:
  u64x8 *start() const { return rows_of(known_); }

  void build(const int32_t *nodes, int64_t count, int64_t vectors, int64_t padded) {
    for (const int32_t node : known_.node_of)
      if (node >= 0)
        known_.slot_of[static_cast<size_t>(node)] = -1;
    known_.vectors = -1; // until all is in place
    known_.paths = padded;
    known_.node_of.assign(static_cast<size_t>(vectors * nodes_per_vector), -1);
    // A megabyte for 10,000 paths: it is kept, since fresh pages cost more than the work.
    const auto words = static_cast<size_t>((vectors * padded + 1) * lanes) + 7;
    if (known_.storage.size() < words)
      known_.storage.resize(words);
    for (int64_t j = 0; j < count; ++j)
      take(nodes[j], j, j);
    for (int64_t v = 0; v < vectors; ++v)
      for (int64_t w = 0; w < paths_.words; w += lanes)
        fill(paths_, nodes + v * nodes_per_vector, std::min(nodes_per_vector, count - v * 512), w,
             start() + v * padded + 64 * w);
    start()[vectors * padded] = u64x8{};
    known_.vectors = vectors;
  }

  void take(int32_t node, int64_t slot, int64_t j) {
    int32_t &known = known_.slot_of[static_cast<size_t>(node)];
    if (known >= 0)
      throw std::invalid_argument("node " + std::to_string(node) + " is observed twice");
    known = static_cast<int32_t>(slot);
    known_.node_of[static_cast<size_t>(slot)] = node;
    slots_[static_cast<size_t>(j)] = known;
  }

  // Frees the slots of nodes that are gone and gives them to new ones. False, and nothing changed,
  // where so many are new that all are better built anew.
  bool update(const int32_t *nodes, int64_t count) {
    std::vector<uint8_t> stays(known_.node_of.size(), 0);
    std::vector<int64_t> fresh;
    for (int64_t j = 0; j < count; ++j) {
      const int32_t slot = known_.slot_of[static_cast<size_t>(nodes[j])];
      slots_[static_cast<size_t>(j)] = slot;
      if (slot < 0)
        fresh.push_back(j);
      else if (stays[static_cast<size_t>(slot)]++)
        throw std::invalid_argument("node " + std::to_string(nodes[j]) + " is observed twice");
    }
    if (static_cast<int64_t>(fresh.size()) > count / 8)
      return false;
    for (size_t slot = 0; slot < stays.size(); ++slot)
      if (const int32_t node = known_.node_of[slot]; node >= 0 && !stays[slot]) {
        write(node, static_cast<int64_t>(slot), false);
        known_.slot_of[static_cast<size_t>(node)] = -1;
        known_.node_of[slot] = -1;
      }
    size_t free = 0;
    for (const int64_t j : fresh) {
      while (known_.node_of[free] >= 0)
        ++free;
      take(nodes[j], static_cast<int64_t>(free), j);
      write(nodes[j], static_cast<int64_t>(free), true);
    }
    return true;
  }

  // Writes the bit of a node in the rows of all its paths.
  void write(int32_t node, int64_t slot, bool on) {
    u64x8 *rows = start() + slot / nodes_per_vector * known_.paths;
    const int64_t lane = slot % nodes_per_vector / 64;
    const uint64_t bit = uint64_t{1} << (slot % 64);
    const uint64_t *row = paths_.bits + node * paths_.stride;
    for (int64_t w = 0; w < paths_.words; ++w)
      for (uint64_t rest = row[w]; rest != 0; rest &= rest - 1)
        if (u64x8 &path = rows[64 * w + __builtin_ctzll(rest)]; on)
          path[lane] |= bit;
        else
          path[lane] &= ~bit;
  }

  // The rows of 8 x 64 paths, from word w on, for up to 512 nodes.
  static void fill(const PathBits &paths, const int32_t *nodes, int64_t count, int64_t w,
                   u64x8 *rows) {
    u64x8 groups[8 * 64];
    const size_t bytes = sizeof(uint64_t) * static_cast<size_t>(std::min(lanes, paths.words - w));
    for (int64_t g = 0; g < 8; ++g) {
      u64x8 *block = groups + 64 * g;
      for (int64_t r = 0; r < 64; ++r) {
        block[r] = u64x8{};
        if (64 * g + r < count)
          std::memcpy(block + r, paths.bits + nodes[64 * g + r] * paths.stride + w, bytes);
      }
      if (64 * g < count)
        transpose(block);
    }
    for (int64_t q = 0; q < 64; ++q)
      transpose_words(groups + q, 64, rows + q, 64);
  }

  const PathBits &paths_;
  ObservedPaths &known_;
  std::vector<int32_t> slots_;
};

// The numbers of a node's paths that count. `list` has room for four more than there are paths.
int64_t list_paths(const PathBits &paths, int32_t node, int32_t *list) {
  int64_t count = 0;
  const uint64_t *row = paths.bits + node * paths.stride;
  for (int64_t w = 0; w < paths.words; ++w) {
    uint64_t rest = row[w];
    if (paths.excluded >= 0 && w == paths.excluded / 64)
      rest &= ~(uint64_t{1} << (paths.excluded % 64));
    const int64_t bits = __builtin_popcountll(rest);
    const auto first = static_cast<int32_t>(64 * w);
    // Most words hold a few bits or none: four are written without asking, so that no branch
    // depends on the data.
    int64_t i = 0;
    do
      for (const int64_t end = i + 4; i < end; ++i, rest &= rest - 1)
        list[count + i] = first + __builtin_ctzll(rest | (uint64_t{1} << 63));
    while (__builtin_expect(i < bits, 0));
    count += bits;
  }
  return count;
}

// 512 counters, bit-sliced: bit l of a counter stands in plane l.
struct Counters {
  u64x8 planes[plane_count];
  int used; // planes that may hold a bit

  // Sum and carry of three bits per counter.
  static u64x8 add(u64x8 &sum, u64x8 b, u64x8 c) {
    const u64x8 half = sum ^ b;
    const u64x8 carry = (sum & b) | (half & c);
    sum = half ^ c;
    return carry;
  }

  // Rows come eight at a time; a carry out of a plane waits for the next, so that two of them
  // cost one adder.
  Counters(const int32_t *list, int64_t count, const u64x8 *rows, const u64x8 *empty) {
    if (count <= 3) { // in a young map most nodes are on a few paths only
      planes[0] = count > 0 ? rows[list[0]] : *empty;
      planes[2] = *empty;
      planes[1] = add(planes[0], count > 1 ? rows[list[1]] : *empty,
                      count > 2 ? rows[list[2]] : *empty);
      used = 3;
      return;
    }
    u64x8 ones = {}, twos = {}, fours = {}, waiting[plane_count];
    int64_t eights = 0;
    used = 3;
    for (int64_t i = 0; i < count; i += 8, ++eights) {
      const u64x8 *row[8];
      for (int64_t k = 0; k < 8; ++k)
        row[k] = i + k < count ? rows + list[i + k] : empty;
      const u64x8 two_a = add(ones, *row[0], *row[1]), two_b = add(ones, *row[2], *row[3]);
      const u64x8 four_a = add(twos, two_a, two_b);
      const u64x8 two_c = add(ones, *row[4], *row[5]), two_d = add(ones, *row[6], *row[7]);
      const u64x8 four_b = add(twos, two_c, two_d);
      u64x8 carry = add(fours, four_a, four_b);
      int level = 3;
      for (int64_t bit = eights; bit & 1; bit >>= 1, ++level)
        carry = add(plane(level), waiting[level], carry);
      waiting[level] = carry;
    }
    planes[0] = ones, planes[1] = twos, planes[2] = fours;
    for (int level = 3; eights >> (level - 3); ++level)
      if ((eights >> (level - 3)) & 1)
        ripple(level, waiting[level]);
  }

  // The plane of a level, empty at first.
  u64x8 &plane(int level) {
    for (; used <= level; ++used)
      planes[used] = u64x8{};
    return planes[level];
  }

  void ripple(int level, u64x8 carry) {
    for (; any(carry); ++level) {
      const u64x8 next = plane(level) & carry;
      planes[level] ^= carry;
      carry = next;
    }
  }
};

// How many of the observed nodes have each count, successes and failures apart.
class Tally {
public:
  struct Entry {
    uint64_t value, successes, failures;
  };

  // Successes and failures of all the nodes that `count` will be told of.
  Tally(int64_t greatest, uint64_t successes, uint64_t failures)
      : successes_(successes), failures_(failures),
        octets_(static_cast<size_t>(greatest / octet + 1)), seen_(octets_.size()) {}

  // Begins anew; no count will be above `greatest`.
  void clear(int64_t greatest) {
    greatest_ = static_cast<size_t>(greatest);
    std::fill_n(seen_.begin(), greatest_ / octet + 1, uint8_t{0});
  }

  void count(const Counters &counters, u64x8 successes, u64x8 failures) {
    split(counters, counters.used - 1, 0, successes | failures, successes);
  }

  // What was counted, values rising; of those above 0 the ones that some counter holds.
  const std::vector<Entry> &entries() {
    // What holds no other value holds 0.
    Entry none{0, successes_, failures_};
    entries_.assign(1, none);
    for (size_t o = 0; o <= greatest_ / octet; ++o)
      for (size_t k = lowest(o); seen_[o] && k < used(o); ++k)
        if (any(octets_[o].all[k])) {
          const uint64_t successes = sum_of(octets_[o].successes[k]);
          const uint64_t failures = sum_of(octets_[o].all[k]) - successes;
          entries_.push_back({octet * o + k, successes, failures});
          none.successes -= successes;
          none.failures -= failures;
        }
    entries_.front() = none;
    return entries_;
  }

private:
  struct Octet {
    u64x8 all[octet], successes[octet];
  };

  // Parts the counters by plane after plane, from the highest; empty parts end.
  void split(const Counters &counters, int level, uint64_t value, u64x8 mask, u64x8 successes) {
    if (!any(mask))
      return;
    if (level < 3)
      return tally_octet(counters, static_cast<size_t>(value), mask, successes);
    const u64x8 plane = counters.planes[level];
    split(counters, level - 1, 2 * value, mask & ~plane, successes);
    split(counters, level - 1, 2 * value + 1, mask & plane, successes);
  }

  void tally_octet(const Counters &counters, size_t number, u64x8 mask, u64x8 successes) {
    Octet &tally = octets_[number];
    const bool first = !seen_[number];
    seen_[number] = 1;
    const size_t end = used(number);
#pragma GCC unroll 8 // so that it is known which planes are turned round
    for (size_t k = 0; k < octet; ++k) {
      if (k >= end)
        break;
      if (k < lowest(number))
        continue;
      u64x8 equal = mask;
      for (size_t level = 0; level < 3; ++level)
        equal &= (k >> level) & 1 ? counters.planes[level] : ~counters.planes[level];
      const u64x8 all = popcount(equal), succeeded = popcount(equal & successes);
      tally.all[k] = first ? all : tally.all[k] + all;
      tally.successes[k] = first ? succeeded : tally.successes[k] + succeeded;
    }
  }

  // Values of an octet that are counted and can occur.
  static size_t lowest(size_t number) { return number == 0 ? 1 : 0; }
  size_t used(size_t number) const {
    return std::min(static_cast<size_t>(octet), greatest_ + 1 - octet * number);
  }

  uint64_t successes_, failures_;
  size_t greatest_ = 0;
  std::vector<Octet> octets_;
  std::vector<uint8_t> seen_;
  std::vector<Entry> entries_;
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
    return value_ == 1 && exponent_ == 0
               ? 0
               : std::log(value_) + static_cast<double>(exponent_) * 0.6931471805599453094;
  }

private:
  double value_ = 1;
  int64_t exponent_ = 0;
};

// Logarithms of n + offset for whole n: candidates with a short history have most of them in
// common, and one frame with the next.
class Logarithms {
public:
  Logarithms(double offset, KnownLogarithms &known) : offset_(offset), known_(known.of) {
    if (known.of.empty() || known.offset != offset) {
      known.of.assign(kKept, 0);
      known.offset = offset;
    }
  }

  bool keeps(uint64_t n) const { return n < kKept; }
  double argument(uint64_t n) const { return static_cast<double>(n) + offset_; }

  double operator()(uint64_t n) {
    if (!keeps(n))
      return std::log(argument(n));
    double &known = known_[n];
    if (known == 0)
      known = std::log(argument(n));
    return known;
  }

private:
  static constexpr size_t kKept = 512;
  double offset_;
  std::vector<double> &known_;
};

// log of the product over j of theta_ij where it succeeded, 1 - theta_ij where it failed:
// theta_ij = (Z_ij + alpha) / total, so the logarithms of the numerators add up and the total is
// taken out. Equal tallies give equal bits, whichever nodes they come from.
class Likelihood {
public:
  Likelihood(double observed, double alpha, ObservedPaths &known)
      : observed_(observed), of_success_(alpha, known.of_success),
        of_total_(observed * alpha, known.of_total),
        of_failure_((observed - 1) * alpha, known.of_failure) {}

  double log(const std::vector<Tally::Entry> &tally) {
    uint64_t all = 0;
    for (const Tally::Entry &entry : tally)
      all += entry.value * (entry.successes + entry.failures);
    double score = -observed_ * of_total_(all);
    Product product;
    for (const Tally::Entry &entry : tally) {
      if (entry.successes > 0)
        score += static_cast<double>(entry.successes) * of_success_(entry.value);
      const uint64_t rest = all - entry.value;
      // A logarithm that is not at hand costs as much as some multiplications.
      if (entry.failures > 8 || (entry.failures > 0 && of_failure_.keeps(rest)))
        score += static_cast<double>(entry.failures) * of_failure_(rest);
      else
        for (uint64_t i = 0; i < entry.failures; ++i)
          product.multiply(of_failure_.argument(rest));
    }
    return score + product.log();
  }

private:
  double observed_;
  Logarithms of_success_, of_total_, of_failure_;
};

// 64 bytes of 0 or 1 as bits.
uint64_t packed(const uint8_t *bytes) {
  uint64_t bits = 0;
  for (int k = 0; k < 8; ++k) {
    uint64_t eight;
    std::memcpy(&eight, bytes + 8 * k, sizeof eight);
    bits |= (eight * 0x0102040810204080) >> 56 << (8 * k);
  }
  return bits;
}

// One bit per observed node: whether it succeeded, and whether it failed.
void outcome_masks(const PathEvidence &evidence, const NodesByPath &nodes,
                   std::vector<u64x8> &successes, std::vector<u64x8> &failures) {
  // A byte each first: one bit after another into the same word would wait for each other.
  std::vector<uint8_t> bytes(2 * successes.size() * nodes_per_vector, 0);
  uint8_t *succeeded = bytes.data(), *failed = succeeded + bytes.size() / 2;
  for (int64_t j = 0; j < evidence.observed_count; ++j) {
    succeeded[nodes.slot(j)] = evidence.outcomes[j] != 0;
    failed[nodes.slot(j)] = evidence.outcomes[j] == 0;
  }
  for (size_t v = 0; v < successes.size(); ++v)
    for (size_t lane = 0; lane < static_cast<size_t>(lanes); ++lane) {
      successes[v][lane] = packed(succeeded + v * nodes_per_vector + 64 * lane);
      failures[v][lane] = packed(failed + v * nodes_per_vector + 64 * lane);
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

// The most paths that any of the nodes is on.
int64_t most_paths(const PathBits &paths, const int32_t *nodes, int64_t count) {
  int64_t most = 0;
  for (int64_t i = 0; i < count; ++i) {
    const uint64_t *row = paths.bits + nodes[i] * paths.stride;
    int64_t bits = 0;
    for (int64_t w = 0; w < paths.words; ++w)
      bits += __builtin_popcountll(row[w]);
    most = std::max(most, bits);
  }
  return most;
}

} // namespace

void co_occurrence(const PathBits &paths, const int32_t *a, int64_t a_count, const int32_t *b,
                   int64_t b_count, int32_t *counts) {
  // The same node may stand in b more than once: each gets a place of its own.
  std::vector<int32_t> distinct(b, b + b_count);
  std::sort(distinct.begin(), distinct.end());
  distinct.erase(std::unique(distinct.begin(), distinct.end()), distinct.end());
  std::vector<size_t> places(static_cast<size_t>(b_count));
  for (int64_t j = 0; j < b_count; ++j)
    places[static_cast<size_t>(j)] = static_cast<size_t>(
        std::lower_bound(distinct.begin(), distinct.end(), b[j]) - distinct.begin());
  ObservedPaths known;
  const auto distinct_count = static_cast<int64_t>(distinct.size());
  const NodesByPath others(paths, known, distinct.data(), distinct_count);
  std::vector<int32_t> list(static_cast<size_t>(64 * paths.words + 4)), row(distinct.size());
  for (int64_t i = 0; i < a_count; ++i) {
    const int64_t length = list_paths(paths, a[i], list.data());
    for (int64_t v = 0; v < others.vectors(); ++v) {
      const Counters counters(list.data(), length, others.rows(v), others.empty());
      for (int64_t j = v * nodes_per_vector; j < std::min(distinct_count, (v + 1) * 512); ++j) {
        int32_t count = 0;
        for (int level = 0; level < counters.used; ++level)
          count |= ((counters.planes[level][j % 512 / 64] >> (j % 64)) & 1) << level;
        row[static_cast<size_t>(j)] = count;
      }
    }
    for (int64_t j = 0; j < b_count; ++j)
      counts[i * b_count + j] = row[places[static_cast<size_t>(j)]];
  }
}

void path_scores(const PathBits &paths, ObservedPaths &known, const int32_t *candidates,
                 int64_t count, const PathEvidence &evidence, double *scores) {
  // theta over a single node is 1 whatever the counts: it says nothing.
  const int64_t observed = evidence.observed_count > 1 ? evidence.observed_count : 0;
  const NodesByPath others(paths, known, evidence.observed, observed);
  std::vector<u64x8> successes(static_cast<size_t>(others.vectors())),
      failures(static_cast<size_t>(others.vectors()));
  if (observed > 0)
    outcome_masks(evidence, others, successes, failures);
  const int64_t most = most_paths(paths, candidates, count);
  Likelihood likelihood(static_cast<double>(observed), evidence.alpha, known);
  Logarithms prior(evidence.gamma, known.of_prior);
  std::vector<int32_t> list(static_cast<size_t>(most + 4));
  uint64_t succeeded = 0;
  for (int64_t j = 0; j < observed; ++j)
    succeeded += evidence.outcomes[j] != 0;
  Tally tally(most, succeeded, static_cast<uint64_t>(observed) - succeeded);
  for (int64_t i = 0; i < count; ++i) {
    scores[i] = 0;
    if (evidence.reference >= 0) {
      const auto reference = static_cast<int32_t>(evidence.reference);
      scores[i] += prior(shared_paths(paths, candidates[i], reference));
    }
    if (observed == 0)
      continue;
    const int64_t length = list_paths(paths, candidates[i], list.data());
    tally.clear(length);
    for (int64_t v = 0; v < others.vectors(); ++v)
      tally.count(Counters(list.data(), length, others.rows(v), others.empty()),
                  successes[static_cast<size_t>(v)], failures[static_cast<size_t>(v)]);
    scores[i] += likelihood.log(tally.entries());
  }
}

void note_on_path(ObservedPaths &known, int32_t node, int64_t path) {
  if (static_cast<size_t>(node) >= known.slot_of.size() || path >= known.paths)
    return; // the rows are built anew before they are used
  if (const int32_t slot = known.slot_of[static_cast<size_t>(node)]; slot >= 0)
    rows_of(known)[slot / nodes_per_vector * known.paths + path][slot % nodes_per_vector / 64] |=
        uint64_t{1} << (slot % 64);
}

} // namespace engram::ENGRAM_ISA
