#include "kernels/hamming.hpp"

namespace engram::ENGRAM_ISA {

void hamming_matrix(const uint64_t *a, int64_t a_count, const uint64_t *b, int64_t b_count,
                    uint16_t *distances) {
  for (int64_t i = 0; i < a_count; ++i) {
    const uint64_t *row = a + 4 * i;
    for (int64_t j = 0; j < b_count; ++j) {
      int bits = 0;
      for (int word = 0; word < 4; ++word)
        bits += __builtin_popcountll(row[word] ^ b[4 * j + word]);
      distances[i * b_count + j] = static_cast<uint16_t>(bits);
    }
  }
}

} // namespace engram::ENGRAM_ISA
