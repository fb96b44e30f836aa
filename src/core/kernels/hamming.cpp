#include "kernels/hamming.hpp"

#include "kernels/width.hpp"

namespace engram::ENGRAM_ISA {

void hamming_matrix(const uint64_t *a, int64_t a_count, const uint64_t *b, int64_t b_count,
                    int width, uint16_t *distances) {
  with_width(width, [&](auto words) {
    for (int64_t i = 0; i < a_count; ++i) {
      const uint64_t *row = a + words * i;
      for (int64_t j = 0; j < b_count; ++j) {
        int bits = 0;
        for (int word = 0; word < words; ++word)
          bits += __builtin_popcountll(row[word] ^ b[words * j + word]);
        distances[i * b_count + j] = static_cast<uint16_t>(bits);
      }
    }
  });
}

} // namespace engram::ENGRAM_ISA
