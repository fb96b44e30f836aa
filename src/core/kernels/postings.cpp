#include "kernels/postings.hpp"

namespace engram::ENGRAM_ISA {

void add_weights(const PlaceIndex &index, const int32_t *words, const double *weights,
                 int64_t count, double *sums) {
  for (int64_t block = 0; block < index.blocks(); ++block) {
    double *const first = sums + block * PlaceIndex::block_size;
    for (int64_t i = 0; i < count; ++i) {
      const std::vector<uint8_t> &list = index.postings(block, words[i]);
      const double weight = weights[i];
      double *at = first - 1;
      for (const uint8_t gap : list) {
        at += gap;
        if (__builtin_expect(gap == PlaceIndex::skip, 0))
          continue;
        *++at += weight;
      }
    }
  }
}

} // namespace engram::ENGRAM_ISA
