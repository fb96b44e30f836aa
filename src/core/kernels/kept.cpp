#include "kernels/kept.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace engram::ENGRAM_ISA {
namespace {

struct Pixel {
  int x, y;
};

// Halves go to the even neighbour, as NumPy rounds.
Pixel whole_pixel(const FrameView &frame, int64_t row) {
  return {static_cast<int>(std::nearbyint(frame.pixels[2 * row])),
          static_cast<int>(std::nearbyint(frame.pixels[2 * row + 1]))};
}

int differing_bits(const uint64_t *a, const uint64_t *b, int width) {
  int bits = 0;
  for (int word = 0; word < width; ++word)
    bits += __builtin_popcountll(a[word] ^ b[word]);
  return bits;
}

// The landmarks of a frame by the image row that they lie in.
class ByImageRow {
public:
  explicit ByImageRow(const FrameView &frame) {
    for (int64_t row = 0; row < frame.count; ++row)
      pixels_.push_back(whole_pixel(frame, row));
    int last = -1;
    for (const Pixel &pixel : pixels_)
      last = std::max(last, pixel.y);
    first_.assign(static_cast<size_t>(last + 2), 0);
    for (const Pixel &pixel : pixels_)
      ++first_[static_cast<size_t>(pixel.y + 1)];
    for (size_t y = 1; y < first_.size(); ++y)
      first_[y] += first_[y - 1];
    rows_.resize(pixels_.size());
    std::vector<int32_t> next(first_);
    for (size_t row = 0; row < pixels_.size(); ++row)
      rows_[static_cast<size_t>(next[static_cast<size_t>(pixels_[row].y)]++)] =
          static_cast<int32_t>(row);
  }

  // Calls work(row) for each landmark within a pixel both ways.
  template <class Work> void near(Pixel at, Work work) const {
    const int end = static_cast<int>(first_.size()) - 1;
    for (int y = std::max(at.y - 1, 0); y <= at.y + 1 && y < end; ++y)
      for (int32_t k = first_[static_cast<size_t>(y)]; k < first_[static_cast<size_t>(y + 1)]; ++k) {
        const int32_t row = rows_[static_cast<size_t>(k)];
        if (std::abs(pixels_[static_cast<size_t>(row)].x - at.x) <= 1)
          work(row);
      }
  }

private:
  std::vector<Pixel> pixels_;
  std::vector<int32_t> first_, rows_; // of image row y: rows_[first_[y]] … rows_[first_[y + 1] - 1]
};

} // namespace

void kept_rows(const FrameView &before, const FrameView &now, int most_bits,
               float most_disparity_px, int32_t *rows) {
  const ByImageRow there(now);
  for (int64_t i = 0; i < before.count; ++i) {
    rows[i] = -1;
    int fewest = most_bits + 1;
    there.near(whole_pixel(before, i), [&](int32_t row) {
      if (std::abs(before.disparity_px[i] - now.disparity_px[row]) > most_disparity_px)
        return;
      const int bits = differing_bits(before.descriptors + before.width * i,
                                      now.descriptors + now.width * row, now.width);
      if (bits < fewest || (bits == fewest && bits <= most_bits && row < rows[i])) {
        fewest = bits;
        rows[i] = row;
      }
    });
  }
}

} // namespace engram::ENGRAM_ISA
