#include "kernels/postings.hpp"

#include <cstring>

namespace engram::ENGRAM_ISA {
namespace {

bool has_zero_byte(uint64_t x) {
  return ((x - 0x0101010101010101) & ~x & 0x8080808080808080) != 0;
}

// `at` is the sum before the first of the places that the list may reach.
void walk(const std::vector<uint8_t> &list, double weight, double *at) {
  const uint8_t *step = list.data(), *const end = step + list.size();
  while (step != end) {
    uint64_t eight = 0;
    if (end - step >= 8)
      std::memcpy(&eight, step, 8);
    if (__builtin_expect(has_zero_byte(eight), 0)) { // a skip, or the last few
      at += *step == 0 ? PlaceIndex::skipped : *step;
      if (*step != 0)
        *at += weight;
      ++step;
      continue;
    }
    for (int i = 0; i < 8; ++i) {
      at += step[i];
      *at += weight;
    }
    step += 8;
  }
}

// Lists lie far apart: what is walked two words from now is asked for while this one is.
void fetch(const std::vector<uint8_t> &list) {
  for (size_t at = 0; at < list.size() && at < 8 * 64; at += 64)
    __builtin_prefetch(list.data() + at);
}

void add_weights_to_block(const PlaceIndex &index, int64_t block, const int32_t *words,
                          const double *weights, int64_t count, double *sums) {
  for (int64_t i = 0; i < count; ++i) {
    if (i + 4 < count)
      __builtin_prefetch(&index.postings(block, words[i + 4]));
    if (i + 2 < count)
      fetch(index.postings(block, words[i + 2]));
    walk(index.postings(block, words[i]), weights[i], sums);
  }
}

} // namespace

void add_weights(const PlaceIndex &index, const int32_t *words, const double *weights,
                 int64_t count, double *sums) {
  for (int64_t block = 0; block < index.blocks(); ++block)
    add_weights_to_block(index, block, words, weights, count,
                         sums + block * PlaceIndex::block_size - 1);
}

} // namespace engram::ENGRAM_ISA
