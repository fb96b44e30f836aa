#include "kernels/postings.hpp"

#include <algorithm>
#include <cstring>
#include <vector>

namespace engram::ENGRAM_ISA {
namespace {

bool has_zero_byte(uint64_t x) {
  return ((x - 0x0101010101010101) & ~x & 0x8080808080808080) != 0;
}

// Steps are checked eight at a time: sums have room for a run that begins within the block.
constexpr int64_t kRoom = 8 * PlaceIndex::skipped;

// False where the list leads out of the block.
bool walk(Postings list, double weight, double *sums, int64_t places) {
  const uint8_t *step = list.begin;
  int64_t at = -1;
  while (step != list.end && at < places) {
    uint64_t eight = 0;
    if (list.end - step >= 8)
      std::memcpy(&eight, step, 8);
    if (__builtin_expect(has_zero_byte(eight), 0)) { // a skip, or the last few
      at += *step == 0 ? PlaceIndex::skipped : *step;
      if (*step != 0)
        sums[at] += weight;
      ++step;
      continue;
    }
    for (int i = 0; i < 8; ++i) {
      at += step[i];
      sums[at] += weight;
    }
    step += 8;
  }
  return at < places;
}

// Lists lie far apart: what is walked two words from now is fetched while this one is.
void fetch(Postings list) {
  for (const uint8_t *at = list.begin; at < list.end && at < list.begin + 8 * 64; at += 64)
    __builtin_prefetch(at);
}

template <class Block>
bool add_weights_to_block(const Block &block, const int32_t *words, const double *weights,
                          int64_t count, double *sums, int64_t places, double *room) {
  std::copy_n(sums, places, room);
  bool within = true;
  for (int64_t i = 0; i < count; ++i) {
    if (i + 2 < count)
      fetch(block.postings(words[i + 2]));
    within = walk(block.postings(words[i]), weights[i], room, places) && within;
  }
  std::copy_n(room, places, sums);
  return within;
}

} // namespace

bool add_weights(const SealedBlock &block, const int32_t *words, const double *weights,
                 int64_t count, double *sums, int64_t places) {
  std::vector<double> room(static_cast<size_t>(places + kRoom));
  return add_weights_to_block(block, words, weights, count, sums, places, room.data());
}

void add_weights(const PlaceIndex &index, const int32_t *words, const double *weights,
                 int64_t count, double *sums) {
  std::vector<double> room(static_cast<size_t>(PlaceIndex::block_size + kRoom));
  for (int64_t number = 0; number < index.sealed(); ++number)
    add_weights_to_block(index.block(number), words, weights, count,
                         sums + number * PlaceIndex::block_size, PlaceIndex::block_size,
                         room.data());
  const int64_t first = index.sealed() * PlaceIndex::block_size;
  if (index.has_open())
    add_weights_to_block(index, words, weights, count, sums + first, index.places() - first,
                         room.data());
}

} // namespace engram::ENGRAM_ISA
