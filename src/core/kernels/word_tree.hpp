// A tree of binary words: nearest word of a descriptor, and the clustering that grows it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "dispatch.hpp"

namespace engram {

constexpr int kMaxBeam = 8;
constexpr int kWordPadding = 8;

// Centres split into their 64-bit words, one column each, padded so that eight may be loaded
// anywhere.
struct Columns {
  int width; // words of a centre
  int64_t stride;
  std::vector<uint64_t> words;

  Columns(int width, int64_t centres)
      : width(width), stride(centres + kWordPadding),
        words(static_cast<size_t>(width * stride), uint64_t{0}) {}

  void assign(const uint64_t *centres, int64_t count) {
    for (int64_t i = 0; i < count; ++i)
      for (int64_t word = 0; word < width; ++word)
        words[static_cast<size_t>(stride * word + i)] = centres[width * i + word];
  }
};

// Nodes in breadth-first order, node 0 the root; the children of node n are bounds[n] up to
// bounds[n + 1], so siblings stand side by side.
struct WordTree {
  Columns centres;
  std::vector<int32_t> bounds;
  std::vector<int32_t> words; // number of a leaf among the leaves; -1 for inner nodes
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // words[i] = number of the leaf that a search along the `beam` nearest branches finds nearest.
    void quantise(const WordTree &tree, const uint64_t *descriptors, int64_t count, int beam,
                  int32_t *words);

    // k-majority (Lloyd's iterations under the Hamming distance): centres[width * j ..] and
    // assignment[i] < number of centres, which is returned: at most k, each with a member.
    int64_t k_majority(const uint64_t *descriptors, int64_t count, int width, int64_t k,
                       int iterations, uint64_t seed, uint64_t *centres, int32_t *assignment);)
