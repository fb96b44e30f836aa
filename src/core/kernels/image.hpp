// Plain records that the extraction kernels share. No functions here: what has code is compiled
// once per instruction set, in a namespace of its own.
#pragma once

#include <cstdint>

namespace engram {

// A grey image without padding between its rows.
struct Image {
  const uint8_t *pixels;
  int64_t width, height;
};

// Of an image so large: false on what is not to be looked at, the robot's own body; null: look at
// all of it.
struct Mask {
  const bool *seen;
  int64_t width, height;
};

struct Corner {
  int16_t x, y;
  uint8_t score;
};

} // namespace engram
