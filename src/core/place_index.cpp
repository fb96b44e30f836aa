#include "place_index.hpp"

namespace engram {

int64_t PlaceIndex::add(const int32_t *words, int64_t count) {
  const auto here = static_cast<int32_t>(places_ % block_size);
  if (here == 0) {
    if (!blocks_.empty()) // that block is full: give back what its lists hold in reserve
      for (std::vector<uint8_t> &list : blocks_.back())
        list.shrink_to_fit();
    blocks_.emplace_back(static_cast<size_t>(words_));
    last_.assign(static_cast<size_t>(words_), -1);
  }
  for (int64_t i = 0; i < count; ++i) {
    const auto word = static_cast<size_t>(words[i]);
    std::vector<uint8_t> &list = blocks_.back()[word];
    int32_t gap = here - last_[word] - 1;
    for (; gap >= skip; gap -= skip)
      list.push_back(skip);
    list.push_back(static_cast<uint8_t>(gap));
    last_[word] = here;
  }
  return places_++;
}

int64_t PlaceIndex::bytes() const {
  size_t total = last_.capacity() * sizeof(int32_t);
  for (const auto &block : blocks_) {
    total += block.capacity() * sizeof(std::vector<uint8_t>);
    for (const std::vector<uint8_t> &list : block)
      total += list.capacity();
  }
  return static_cast<int64_t>(total);
}

} // namespace engram
