#include "kernels/sides.hpp"

#include <algorithm>
#include <cmath>

#include "kernels/buffer.hpp"

namespace engram::ENGRAM_ISA {
namespace {

// Blocks of the halved images, of which every other row is read.
constexpr int64_t block_px = 8, full_block_px = 2 * block_px;
constexpr int64_t rows_read = block_px / 2, block_pixels = rows_read * block_px;
// Windows, blocks: large enough that one holds near and far things; how far apart they are.
constexpr int64_t window_columns = 10, window_rows = 5, step_columns = 5, step_rows = 2;
// What the right image shows at its right edge lies outside the left one, blocks.
constexpr int64_t unseen_columns = 3;
// Added to the contrast, grey levels: what differs by less is noise.
constexpr float least_contrast = 5;

// Sums of a block's grey levels and squares.
struct Block {
  int32_t greys, squares;
  bool hidden; // it shows the body
};

struct Window {
  float mean, spread;
  bool hidden;
};

struct Grid {
  int64_t columns, rows, window_columns, window_rows; // blocks
};

void sum_blocks(const Image &half, const Grid &grid, Block *blocks, Buffer<int32_t> &memory) {
  int32_t *__restrict__ greys = memory.room_for(2 * half.width);
  int32_t *__restrict__ squares = greys + half.width;
  for (int64_t row = 0; row < grid.rows; ++row) {
    std::fill(greys, greys + 2 * half.width, 0);
    for (int64_t y = 0; y < rows_read; ++y) {
      const uint8_t *pixels = half.pixels + (row * block_px + 2 * y) * half.width;
      for (int64_t x = 0; x < half.width; ++x) {
        const int32_t grey = pixels[x];
        greys[x] += grey;
        squares[x] += grey * grey;
      }
    }
    for (int64_t column = 0; column < grid.columns; ++column) {
      Block block{0, 0, false};
      for (int64_t x = column * block_px; x < (column + 1) * block_px; ++x) {
        block.greys += greys[x];
        block.squares += squares[x];
      }
      *blocks++ = block;
    }
  }
}

void hide_blocks(const Mask &mask, const Grid &grid, Block *blocks) {
  for (int64_t y = 0; y < grid.rows * full_block_px; ++y)
    for (int64_t x = 0; x < grid.columns * full_block_px; ++x)
      if (!mask.seen[y * mask.width + x])
        blocks[y / full_block_px * grid.columns + x / full_block_px].hidden = true;
}

Block &operator+=(Block &sum, const Block &block) {
  sum = {sum.greys + block.greys, sum.squares + block.squares, sum.hidden || block.hidden};
  return sum;
}

// Adds up the blocks of a window's rows, column by column.
void sum_columns(const Block *blocks, const Grid &grid, int64_t row, Block *columns) {
  for (int64_t x = 0; x < grid.columns; ++x) {
    columns[x] = {0, 0, false};
    for (int64_t y = row; y < row + grid.window_rows; ++y)
      columns[x] += blocks[y * grid.columns + x];
  }
}

Window window_of(const Block *columns, const Grid &grid) {
  Block sum{0, 0, false};
  for (int64_t x = 0; x < grid.window_columns; ++x)
    sum += columns[x];
  const auto pixels = static_cast<float>(grid.window_columns * grid.window_rows * block_pixels);
  const float mean = static_cast<float>(sum.greys) / pixels;
  const float variance = static_cast<float>(sum.squares) / pixels - mean * mean;
  return {mean, std::sqrt(std::max(variance, 0.0f)), sum.hidden};
}

float misfit(const Window &left, const Window &right) {
  const float brighter = right.mean - left.mean, stronger = right.spread - left.spread;
  return std::sqrt(brighter * brighter + stronger * stronger) / (left.spread + least_contrast);
}

// Between a window and those of the left image where it may lie; negative where one is hidden.
float least_misfit(const Window *left, int64_t count, const Window &right) {
  float least = misfit(left[0], right);
  for (int64_t k = 0; k < count; ++k) {
    if (left[k].hidden)
      return -1;
    least = std::min(least, misfit(left[k], right));
  }
  return least;
}

// Of the windows by whose mean and deviation an image is evened, px of a halved image: a little
// more than the coarse search's, so that its windows keep a shape.
constexpr int64_t even_radius = 7;
// Grey levels to a standard deviation: truncated differences reach a little more than one.
constexpr float even_scale = 32;

// Sums over the rows about one: of each column, then of all columns before each.
struct RunningSums {
  int32_t *greys, *squares, *greys_to, *squares_to;

  void change(const uint8_t *__restrict__ pixels, int64_t width, int32_t by) {
    int32_t *__restrict__ grey_sums = greys, *__restrict__ square_sums = squares;
    for (int64_t x = 0; x < width; ++x) {
      const int32_t grey = pixels[x];
      grey_sums[x] += by * grey;
      square_sums[x] += by * grey * grey;
    }
  }

  void add_up(int64_t width) {
    int32_t grey_sum = 0, square_sum = 0;
    for (int64_t x = 0; x < width; ++x) {
      greys_to[x] = grey_sum;
      squares_to[x] = square_sum;
      grey_sum += greys[x];
      square_sum += squares[x];
    }
    greys_to[width] = grey_sum;
    squares_to[width] = square_sum;
  }
};

inline uint8_t evened_grey(float grey, int32_t sum, int32_t squares, float pixels) {
  const float mean = static_cast<float>(sum) / pixels;
  const float variance = static_cast<float>(squares) / pixels - mean * mean;
  // 1 grey level²: without contrast there is only noise.
  const float apart = (grey - mean) / std::sqrt(std::max(variance, 0.0f) + 1);
  const float level = 128.5f + even_scale * apart;
  return static_cast<uint8_t>(static_cast<int32_t>(std::min(std::max(level, 0.0f), 255.0f)));
}

} // namespace

float side_difference(const Image &left_half, const Image &right_half, const Mask &mask,
                      int max_disparity_px) {
  static thread_local Buffer<Block> blocks;
  static thread_local Buffer<Window> windows;
  static thread_local Buffer<int32_t> memory;
  static thread_local Buffer<float> misfits;
  const int64_t columns = left_half.width / block_px, rows = left_half.height / block_px;
  if (columns == 0 || rows == 0)
    return 0;
  const Grid grid{columns, rows, std::min(window_columns, columns), std::min(window_rows, rows)};
  Block *left = blocks.room_for(2 * columns * (rows + 1)), *right = left + columns * rows;
  Block *left_columns = right + columns * rows, *right_columns = left_columns + columns;
  sum_blocks(left_half, grid, left, memory);
  sum_blocks(right_half, grid, right, memory);
  if (mask.seen != nullptr)
    hide_blocks(mask, grid, left);

  const int64_t across = columns - grid.window_columns + 1, down = rows - grid.window_rows + 1;
  const int64_t compared = std::max<int64_t>(across - unseen_columns, 1);
  const int64_t disparities = max_disparity_px / full_block_px + 2;
  Window *there = windows.room_for(across);
  float *found = misfits.room_for(compared * down), *end = found;
  for (int64_t y = 0; y < down; y += step_rows) {
    sum_columns(left, grid, y, left_columns);
    sum_columns(right, grid, y, right_columns);
    for (int64_t x = 0; x < across; ++x)
      there[x] = window_of(left_columns + x, grid);
    for (int64_t x = 0; x < compared; x += step_columns) {
      const float least = least_misfit(there + x, std::min(disparities, across - x),
                                       window_of(right_columns + x, grid));
      if (least >= 0)
        *end++ = least;
    }
  }
  if (end == found)
    return 0;
  float *quarter_above = found + 3 * (end - found - 1) / 4;
  std::nth_element(found, quarter_above, end);
  return *quarter_above;
}

void even_contrast(const Image &image, uint8_t *evened) {
  static thread_local Buffer<int32_t> memory;
  const int64_t width = image.width, height = image.height, radius = even_radius;
  int32_t *room = memory.room_for(4 * width + 2);
  RunningSums sums{room, room + width, room + 2 * width, room + 3 * width + 1};
  std::fill(room, room + 2 * width, 0);
  const auto row_at = [&](int64_t y) { return image.pixels + y * width; };
  for (int64_t y = 0; y < std::min(radius, height); ++y)
    sums.change(row_at(y), width, 1);
  for (int64_t y = 0; y < height; ++y) {
    if (y + radius < height)
      sums.change(row_at(y + radius), width, 1);
    if (y > radius)
      sums.change(row_at(y - radius - 1), width, -1);
    sums.add_up(width);
    const int64_t rows = std::min(y + radius + 1, height) - std::max<int64_t>(y - radius, 0);
    const uint8_t *__restrict__ pixels = row_at(y);
    uint8_t *__restrict__ out = evened + y * width;
    const auto even = [&](int64_t x, int64_t from, int64_t to) {
      out[x] = evened_grey(pixels[x], sums.greys_to[to] - sums.greys_to[from],
                           sums.squares_to[to] - sums.squares_to[from],
                           static_cast<float>(rows * (to - from)));
    };
    // Windows end with the image.
    const auto even_at_edge = [&](int64_t from, int64_t to) {
      for (int64_t x = from; x < to; ++x)
        even(x, std::max<int64_t>(x - radius, 0), std::min(x + radius + 1, width));
    };
    const int64_t left = std::min(radius, width), right = std::max(width - radius, left);
    even_at_edge(0, left);
    for (int64_t x = left; x < right; ++x)
      even(x, x - radius, x + radius + 1);
    even_at_edge(right, width);
  }
}

} // namespace engram::ENGRAM_ISA
