// An inverted index: for each word the places that show it, as coded gaps between their numbers.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace engram {

// The places of one block that show one word. A posting is the step from the last of them, 1 to
// 255, in one byte; 0 skips 255 places.
struct Postings {
  const uint8_t *begin, *end;
};

// A full block in the bytes that maps store: u32 ends of the lists of all words, then the lists.
// A place that shows 350 of 10,000 words takes about 370 bytes. The bytes may be a stranger's.
class SealedBlock {
public:
  SealedBlock(const uint8_t *body, size_t bytes, int64_t words)
      : ends_(body), lists_(body + 4 * words), most_(bytes - 4 * static_cast<size_t>(words)) {}

  static bool holds(size_t bytes, int64_t words) { return bytes / 4 >= static_cast<size_t>(words); }

  // Empty where the ends make no sense.
  Postings postings(int64_t word) const {
    const uint32_t begin = word == 0 ? 0 : end_of(word - 1), end = end_of(word);
    if (begin > end || end > most_)
      return {lists_, lists_};
    return {lists_ + begin, lists_ + end};
  }

private:
  uint32_t end_of(int64_t word) const {
    uint32_t end;
    std::memcpy(&end, ends_ + 4 * word, 4);
    return end;
  }

  const uint8_t *ends_, *lists_;
  size_t most_;
};

// Places come in blocks, so that the sums of a block stay in the first cache while the postings of
// all words run over them.
class PlaceIndex {
public:
  static constexpr int64_t block_size = 8192;
  static constexpr int32_t skipped = 255;

  explicit PlaceIndex(int64_t words) : words_(words) {}

  int64_t words() const { return words_; }
  int64_t places() const { return places_; }
  int64_t sealed() const { return static_cast<int64_t>(sealed_.size()); }
  int64_t bytes() const;

  // `words` rise strictly and lie in range: the caller's business.
  int64_t add(const int32_t *words, int64_t count);

  const std::vector<uint8_t> &body(int64_t block) const {
    return sealed_[static_cast<size_t>(block)];
  }
  SealedBlock block(int64_t number) const {
    return {body(number).data(), body(number).size(), words_};
  }

  // Of the block that is not full yet.
  Postings postings(int64_t word) const {
    const std::vector<uint8_t> &list = open_[static_cast<size_t>(word)];
    return {list.data(), list.data() + list.size()};
  }
  bool has_open() const { return !open_.empty(); }

private:
  void seal();

  int64_t words_, places_ = 0;
  std::vector<std::vector<uint8_t>> sealed_;
  std::vector<std::vector<uint8_t>> open_;
  std::vector<int32_t> last_; // within the open block, the last place of each word; -1 before it
};

// Numbers of the `most` greatest scores, greatest first, of equal ones the first.
std::vector<int64_t> best_scores(const double *scores, int64_t count, int64_t most);

} // namespace engram
