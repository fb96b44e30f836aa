// An inverted index: for each word the places that show it, as coded gaps between their numbers.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace engram {

// Places come in blocks, so that the sums of a block stay in the second-level cache while the
// postings of all words run over them. A posting is the step from the last place that shows the
// word, 1 to 255, in one byte; 0 skips 255 places. A place that shows 500 of 10,000 words takes
// about 500 bytes.
class PlaceIndex {
public:
  static constexpr int64_t block_size = 1 << 16;
  static constexpr int32_t skipped = 255;

  explicit PlaceIndex(int64_t words) : words_(words) {}

  int64_t words() const { return words_; }
  int64_t places() const { return places_; }
  int64_t blocks() const { return static_cast<int64_t>(blocks_.size()); }
  int64_t bytes() const;

  // `words` rise strictly and lie in range: the caller's business.
  int64_t add(const int32_t *words, int64_t count);

  const std::vector<uint8_t> &postings(int64_t block, int64_t word) const {
    return blocks_[static_cast<size_t>(block)][static_cast<size_t>(word)];
  }

private:
  int64_t words_, places_ = 0;
  std::vector<std::vector<std::vector<uint8_t>>> blocks_;
  std::vector<int32_t> last_; // within the open block, the last place of each word; -1 before it
};

// Numbers of the `most` greatest scores, greatest first, of equal ones the first.
std::vector<int64_t> best_scores(const double *scores, int64_t count, int64_t most);

} // namespace engram
