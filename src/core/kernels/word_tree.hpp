// A tree of binary words: nearest word of a descriptor, and the clustering that grows it.
#pragma once

#include <cstdint>
#include <vector>

#include "dispatch.hpp"

namespace engram {

// Nodes in breadth-first order, node 0 the root; the children of node n are bounds[n] up to
// bounds[n + 1], so siblings stand side by side. Centres are split into their four 64-bit words,
// one array each, padded so that eight may be loaded anywhere.
struct WordTree {
  std::vector<uint64_t> centres[4];
  std::vector<int32_t> bounds;
  std::vector<int32_t> words; // number of a leaf among the leaves; -1 for inner nodes
};

constexpr int kMaxBeam = 8;
constexpr int kWordPadding = 8;

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // words[i] = number of the leaf that a search along the `beam` nearest branches finds nearest.
    void quantise(const WordTree &tree, const uint64_t *descriptors, int64_t count, int beam,
                  int32_t *words);

    // k-majority (Lloyd's iterations under the Hamming distance): centres[4 * j ..] and
    // assignment[i] < number of centres, which is returned: at most k, each with a member.
    int64_t k_majority(const uint64_t *descriptors, int64_t count, int64_t k, int iterations,
                       uint64_t seed, uint64_t *centres, int32_t *assignment);)
