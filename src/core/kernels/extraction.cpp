#include "kernels/extraction.hpp"

#include <algorithm>
#include <cstring>

#include "kernels/brief.hpp"
#include "kernels/buffer.hpp"
#include "kernels/corners.hpp"
#include "kernels/pyramid.hpp"

namespace engram::ENGRAM_ISA {
namespace {

struct Workspace {
  Buffer<uint8_t> left_levels[most_octaves], right_half, smoothed;
  Buffer<Corner> corners, kept;
  Buffer<int32_t> order;
  Buffer<float> disparities; // two per corner: disparity, σ
};

Image halved(const Image &image, Buffer<uint8_t> &memory) {
  const Image half{memory.room_for((image.width / 2) * (image.height / 2)), image.width / 2,
                   image.height / 2};
  halve(image, const_cast<uint8_t *>(half.pixels));
  return half;
}

// The corner's position in the full-size image: pixel centres are at integers.
inline float at_full_size(int coordinate, int scale) {
  return (static_cast<float>(coordinate) + 0.5f) * static_cast<float>(scale) - 0.5f;
}

inline bool inside_border(const Image &image, int64_t x, int64_t y) {
  return x >= corner_border && y >= corner_border && x < image.width - corner_border &&
         y < image.height - corner_border;
}

// Landmarks of one octave, written from `first` on; returns how many.
int64_t extract_octave(const Image &level, int octave, int64_t wanted, const StereoImages &images,
                       const ExtractionSettings &settings, const ExtractedLandmarks &out,
                       int64_t first, int64_t *corner_count, Workspace &work) {
  Corner *corners = work.corners.room_for(most_corners(level.width, level.height));
  const int64_t count = detect_corners(level, settings.fast_threshold, corners);
  *corner_count += count;
  int32_t *order = work.order.room_for(count);
  order_corners(corners, count, level, settings.cell_px, order);

  float *disparities = work.disparities.room_for(2 * count);
  std::memset(disparities, 0, 2 * count * sizeof(float));
  const int scale = 1 << octave;
  int64_t found = 0;
  for (int64_t i = 0; i < count && found < wanted; ++i) {
    const Corner &corner = corners[order[i]];
    const int64_t x = corner.x * scale + scale / 2, y = corner.y * scale + scale / 2;
    float *measured = disparities + 2 * order[i];
    if (inside_border(images.left, x, y) &&
        measure_disparity(images, x, y, settings.stereo, measured, measured + 1))
      ++found;
    else
      measured[0] = 0;
  }

  // Back to raster order: neighbours in the image are neighbours in memory.
  Corner *kept = work.kept.room_for(found);
  int64_t at = 0;
  for (int64_t i = 0; i < count; ++i) {
    if (disparities[2 * i] == 0)
      continue;
    kept[at] = corners[i];
    const int64_t row = first + at++;
    out.pixels[2 * row] = at_full_size(corners[i].x, scale);
    out.pixels[2 * row + 1] = at_full_size(corners[i].y, scale);
    out.disparity_px[row] = disparities[2 * i];
    out.sigma_px[row] = disparities[2 * i + 1];
    out.octaves[row] = static_cast<uint8_t>(octave);
  }
  if (out.descriptors != nullptr && found > 0) {
    uint8_t *smoothed = work.smoothed.room_for(level.width * level.height);
    smooth(level, smoothed);
    describe({smoothed, level.width, level.height}, kept, found, out.descriptors + 4 * first);
  }
  return found;
}

// Landmarks that octaves 0 to `octave` may have together: shares 1 : 1/2 : 1/4 ….
int64_t share_up_to(int octave, const ExtractionSettings &settings) {
  const int64_t all = (1 << settings.octaves) - 1;
  const int64_t so_far = all - ((1 << (settings.octaves - 1 - octave)) - 1);
  return settings.landmarks * so_far / all;
}

} // namespace

ExtractionCounts extract(const Image &left, const Image &right, const ExtractionSettings &settings,
                         const ExtractedLandmarks &out) {
  static thread_local Workspace work;
  const StereoImages images{left, right, halved(left, work.left_levels[0]),
                            halved(right, work.right_half)};
  ExtractionCounts counts{0, 0};
  Image level = left;
  for (int octave = 0; octave < settings.octaves; ++octave) {
    if (octave == 1)
      level = images.left_half;
    else if (octave > 1)
      level = halved(level, work.left_levels[octave - 1]);
    const int64_t wanted = share_up_to(octave, settings) - counts.landmarks;
    counts.landmarks += extract_octave(level, octave, wanted, images, settings, out,
                                       counts.landmarks, &counts.corners, work);
  }
  return counts;
}

} // namespace engram::ENGRAM_ISA
