#include "kernels/corners.hpp"

#include <cstring>

#include "kernels/buffer.hpp"
#include "kernels/lanes.hpp"

namespace engram::ENGRAM_ISA {
namespace {

// Less than half a pixel, so that the place still rounds to the corner's pixel once it is stored.
constexpr float most_offset = 0.45f;

// The circle of 16 pixels, clockwise from the top.
constexpr int circle_x[16] = {0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1};
constexpr int circle_y[16] = {-3, -3, -2, -1, 0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3};

// The largest over all arcs of nine of the smallest value on the arc (with `least` = smaller), or
// the smallest of the largest. Two arcs that share eight pixels are taken together.
template <Bytes (*least)(Bytes, Bytes), Bytes (*most)(Bytes, Bytes)>
inline Bytes best_arc(const Bytes (&on_circle)[16]) {
  Bytes two[8], four[8];
  for (int k = 0; k < 8; ++k)
    two[k] = least(on_circle[2 * k + 1], on_circle[(2 * k + 2) & 15]);
  for (int k = 0; k < 8; ++k)
    four[k] = least(two[k], two[(k + 1) & 7]);
  Bytes best;
  for (int k = 0; k < 8; ++k) {
    const Bytes eight = least(four[k], four[(k + 2) & 7]);
    const Bytes ends = most(on_circle[2 * k], on_circle[(2 * k + 9) & 15]);
    const Bytes nine = least(eight, ends);
    best = k == 0 ? nine : most(best, nine);
  }
  return best;
}

// scores[x] for x in [from, to), and garbage for up to `lanes` - 1 more.
void score_row(const uint8_t *row, int64_t width, int64_t from, int64_t to, uint8_t *scores) {
  int64_t offsets[16];
  for (int k = 0; k < 16; ++k)
    offsets[k] = circle_y[k] * width + circle_x[k];
  for (int64_t x = from; x < to; x += lanes) {
    Bytes on_circle[16];
    for (int k = 0; k < 16; ++k)
      on_circle[k] = load<Bytes>(row + x + offsets[k]);
    const Bytes centre = load<Bytes>(row + x);
    const Bytes bright = difference_or_zero(best_arc<smaller, larger>(on_circle), centre);
    const Bytes dark = difference_or_zero(centre, best_arc<larger, smaller>(on_circle));
    store(scores + x, larger(bright, dark));
  }
}

// Appends the local maxima of the middle row at x in [from, to).
Corner *keep_maxima(const uint8_t *above, const uint8_t *middle, const uint8_t *below, int64_t from,
                    int64_t to, int threshold, int64_t y, Corner *corners) {
  const Bytes floor = all(static_cast<uint8_t>(threshold));
  for (int64_t x = from; x < to; x += lanes) {
    const Bytes score = load<Bytes>(middle + x);
    const Bytes earlier =
        larger(larger(load<Bytes>(above + x - 1), load<Bytes>(above + x)),
               larger(load<Bytes>(above + x + 1), load<Bytes>(middle + x - 1)));
    const Bytes later = larger(larger(load<Bytes>(below + x - 1), load<Bytes>(below + x)),
                               larger(load<Bytes>(below + x + 1), load<Bytes>(middle + x + 1)));
    uint64_t kept = bits_of((Bytes)((score > floor) & (score >= earlier) & (score > later)));
    if (to - x < lanes)
      kept &= (uint64_t{1} << (to - x)) - 1;
    for (; kept != 0; kept &= kept - 1) {
      const int64_t at = x + __builtin_ctzll(kept);
      *corners++ = {static_cast<int16_t>(at), static_cast<int16_t>(y), middle[at]};
    }
  }
  return corners;
}

} // namespace

int64_t detect_corners(const Image &image, int threshold, Corner *corners, uint8_t *scores) {
  const int64_t width = image.width;
  const int64_t from = corner_border, to = width - corner_border;
  const int64_t top = corner_border, bottom = image.height - corner_border;
  if (from >= to || top >= bottom)
    return 0;
  // Blocks overrun a row's end: into the rows below, of which enough are left, and in the scores
  // into padding. Two more pixels on each side are for refine_corner().
  const int64_t stride = score_stride(width);
  Corner *end = corners;
  for (int64_t y = top - 2; y < bottom + 2; ++y) {
    uint8_t *row = scores + y * stride;
    score_row(image.pixels + y * width, width, from - 2, to + 2, row);
    if (y > top && y <= bottom)
      end = keep_maxima(row - 2 * stride, row - stride, row, from, to, threshold, y - 1, end);
  }
  return end - corners;
}

void refine_corner(const Corner &corner, const uint8_t *scores, int64_t width, float *offset) {
  const int64_t stride = score_stride(width);
  const uint8_t *centre = scores + corner.y * stride + corner.x;
  // Sixteen times the smoothed score.
  const auto smoothed = [=](int64_t shift) {
    const uint8_t *at = centre + shift;
    const int corners_sum = at[-stride - 1] + at[-stride + 1] + at[stride - 1] + at[stride + 1];
    return 4 * at[0] + 2 * (at[-1] + at[1] + at[-stride] + at[stride]) + corners_sum;
  };
  const int here = smoothed(0);
  for (int axis = 0; axis < 2; ++axis) {
    const int64_t step = axis == 0 ? 1 : stride;
    const int before = smoothed(-step), after = smoothed(step);
    const int curvature = 2 * here - before - after;
    const float peak =
        curvature > 0 ? static_cast<float>(after - before) / static_cast<float>(2 * curvature) : 0;
    offset[axis] = peak < -most_offset ? -most_offset : peak > most_offset ? most_offset : peak;
  }
}

void order_corners(const Corner *corners, int64_t count, const Image &image, int64_t cell_px,
                   int32_t *order) {
  static thread_local Buffer<int32_t> scratch;
  const int64_t columns = (image.width + cell_px - 1) / cell_px;
  const int64_t cells = columns * ((image.height + cell_px - 1) / cell_px);
  const int64_t most_rounds = most_corners(cell_px, cell_px);
  int32_t *by_score =
      scratch.room_for(2 * count + cells + most_rounds + 1 + image.width + image.height);
  int32_t *round_of = by_score + count;
  int32_t *in_cell = round_of + count;
  int32_t *start_of_round = in_cell + cells;
  // A division for each pixel of a side, not two for each corner.
  int32_t *column_of = start_of_round + most_rounds + 1;
  int32_t *row_of = column_of + image.width;
  for (int64_t x = 0; x < image.width; ++x)
    column_of[x] = static_cast<int32_t>(x / cell_px);
  for (int64_t y = 0; y < image.height; ++y)
    row_of[y] = static_cast<int32_t>(y / cell_px * columns);

  // Best score first: a counting sort, which keeps raster order among equals.
  int32_t starts[257] = {};
  for (int64_t i = 0; i < count; ++i)
    ++starts[256 - corners[i].score];
  for (int score = 1; score <= 256; ++score)
    starts[score] += starts[score - 1];
  for (int64_t i = 0; i < count; ++i)
    by_score[starts[255 - corners[i].score]++] = static_cast<int32_t>(i);

  // How many better corners a corner's cell has is its round; a second counting sort by it.
  std::memset(in_cell, 0, (cells + most_rounds + 1) * sizeof(int32_t));
  for (int64_t i = 0; i < count; ++i) {
    const Corner &corner = corners[by_score[i]];
    round_of[i] = in_cell[row_of[corner.y] + column_of[corner.x]]++;
    ++start_of_round[round_of[i] + 1];
  }
  for (int64_t round = 1; round <= most_rounds; ++round)
    start_of_round[round] += start_of_round[round - 1];
  for (int64_t i = 0; i < count; ++i)
    order[start_of_round[round_of[i]]++] = by_score[i];
}

} // namespace engram::ENGRAM_ISA
