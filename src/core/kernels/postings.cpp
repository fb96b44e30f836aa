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

} // namespace

void add_weights(const PlaceIndex &index, const int32_t *words, const double *weights,
                 int64_t count, double *sums) {
  for (int64_t block = 0; block < index.blocks(); ++block)
    for (int64_t i = 0; i < count; ++i)
      walk(index.postings(block, words[i]), weights[i],
           sums + block * PlaceIndex::block_size - 1);
}

} // namespace engram::ENGRAM_ISA
