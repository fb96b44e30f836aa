#include "place_index.hpp"

#include <algorithm>
#include <utility>

namespace engram {

int64_t PlaceIndex::add(const int32_t *words, int64_t count) {
  const auto here = static_cast<int32_t>(places_ % block_size);
  if (here == 0) {
    open_.assign(static_cast<size_t>(words_), {});
    last_.assign(static_cast<size_t>(words_), -1);
  }
  for (int64_t i = 0; i < count; ++i) {
    const auto word = static_cast<size_t>(words[i]);
    std::vector<uint8_t> &list = open_[word];
    int32_t step = here - last_[word];
    for (; step > skipped; step -= skipped)
      list.push_back(0);
    list.push_back(static_cast<uint8_t>(step));
    last_[word] = here;
  }
  if (++places_ % block_size == 0)
    seal();
  return places_ - 1;
}

void PlaceIndex::seal() {
  std::vector<uint8_t> body(4 * open_.size());
  for (size_t word = 0; word < open_.size(); ++word) {
    body.insert(body.end(), open_[word].begin(), open_[word].end());
    const auto end = static_cast<uint32_t>(body.size() - 4 * open_.size());
    std::memcpy(body.data() + 4 * word, &end, 4);
  }
  body.shrink_to_fit();
  sealed_.push_back(std::move(body));
  open_.clear();
}

int64_t PlaceIndex::bytes() const {
  size_t total = last_.capacity() * sizeof(int32_t);
  for (const std::vector<uint8_t> &body : sealed_)
    total += body.capacity();
  for (const std::vector<uint8_t> &list : open_)
    total += sizeof(list) + list.capacity();
  return static_cast<int64_t>(total);
}

std::vector<int64_t> best_scores(const double *scores, int64_t count, int64_t most) {
  const auto better = [scores](int64_t a, int64_t b) {
    return scores[a] > scores[b] || (scores[a] == scores[b] && a < b);
  };
  std::vector<int64_t> best; // a heap whose front is the worst
  for (int64_t i = 0; i < count && most > 0; ++i) {
    if (static_cast<int64_t>(best.size()) == most) {
      if (!(scores[i] > scores[best.front()])) // an equal one that comes later is worse
        continue;
      std::pop_heap(best.begin(), best.end(), better);
      best.pop_back();
    }
    best.push_back(i);
    std::push_heap(best.begin(), best.end(), better);
  }
  std::sort_heap(best.begin(), best.end(), better);
  return best;
}

} // namespace engram
