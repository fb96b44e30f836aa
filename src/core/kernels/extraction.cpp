#include "kernels/extraction.hpp"

#include <algorithm>

#include "kernels/brief.hpp"
#include "kernels/buffer.hpp"
#include "kernels/corners.hpp"
#include "kernels/pyramid.hpp"
#include "kernels/sides.hpp"

namespace engram::ENGRAM_ISA {
namespace {

struct Workspace {
  Buffer<uint8_t> left_levels[most_octaves], right_half, right_quarter, smoothed, scores,
      evened[4];
  Buffer<Corner> corners, kept;
  Buffer<int32_t> order;
  Buffer<float> measured; // four per corner: u, v, disparity, σ
};

Image halved(const Image &image, Buffer<uint8_t> &memory) {
  const Image half{memory.room_for((image.width / 2) * (image.height / 2)), image.width / 2,
                   image.height / 2};
  halve(image, const_cast<uint8_t *>(half.pixels));
  return half;
}

// The corner's position in the full-size image: pixel centres are at integers.
inline float at_full_size(float coordinate, int scale) {
  return (coordinate + 0.5f) * static_cast<float>(scale) - 0.5f;
}

inline bool inside_border(const Image &image, int64_t x, int64_t y) {
  return x >= corner_border && y >= corner_border && x < image.width - corner_border &&
         y < image.height - corner_border;
}

// The pair as the search reads it.
StereoImages compared(const StereoImages &images, Buffer<uint8_t> *memory) {
  if (!images.sides_differ)
    return images;
  const auto evened = [](const Image &half, Buffer<uint8_t> &memory) {
    uint8_t *pixels = memory.room_for(half.width * half.height);
    even_contrast(half, pixels);
    return Image{pixels, half.width, half.height};
  };
  return {images.left, images.right, evened(images.left_half, memory[0]),
          evened(images.right_half, memory[1]), true};
}

// How one look at a pair finds corners and their disparities.
struct Look {
  int32_t threshold;
  Image left, left_half; // in which corners are found
  StereoImages images, halved; // `halved` is empty where it is not to be searched
  StereoSettings stereo, half_stereo;
};

StereoSettings at_half_size(StereoSettings stereo) {
  stereo.max_disparity_px = (stereo.max_disparity_px + 1) / 2;
  stereo.min_disparity_px /= 2;
  stereo.max_sigma_px /= 2;
  return stereo;
}

// Disparity and σ at a corner of the full-size image.
bool measure(const Look &look, int64_t x, int64_t y, float *disparity_px, float *sigma_px) {
  if (inside_border(look.images.left, x, y) &&
      measure_disparity(look.images, x, y, look.stereo, disparity_px, sigma_px))
    return true;
  if (!inside_border(look.halved.left, x / 2, y / 2) ||
      !measure_disparity(look.halved, x / 2, y / 2, look.half_stereo, disparity_px, sigma_px))
    return false;
  *disparity_px *= 2;
  *sigma_px *= 2;
  return true;
}

// Landmarks of one octave, written from `first` on; returns how many.
int64_t extract_octave(const Image &level, int octave, int64_t wanted, const Look &look,
                       int32_t cell_px, const ExtractedLandmarks &out, int64_t first,
                       int64_t *corner_count, Workspace &work) {
  Corner *corners = work.corners.room_for(most_corners(level.width, level.height));
  uint8_t *scores = work.scores.room_for(score_stride(level.width) * level.height);
  const int64_t count = detect_corners(level, look.threshold, corners, scores);
  *corner_count += count;
  int32_t *order = work.order.room_for(count);
  order_corners(corners, count, level, cell_px, order);

  float *measured = work.measured.room_for(4 * count);
  for (int64_t i = 0; i < count; ++i)
    measured[4 * i + 2] = 0;
  const int scale = 1 << octave;
  int64_t found = 0;
  for (int64_t i = 0; i < count && found < wanted; ++i) {
    const Corner &corner = corners[order[i]];
    float *own = measured + 4 * order[i];
    refine_corner(corner, scores, level.width, own);
    own[0] = at_full_size(static_cast<float>(corner.x) + own[0], scale);
    own[1] = at_full_size(static_cast<float>(corner.y) + own[1], scale);
    const auto x = static_cast<int64_t>(own[0] + 0.5f), y = static_cast<int64_t>(own[1] + 0.5f);
    if (measure(look, x, y, own + 2, own + 3))
      ++found;
    else
      own[2] = 0;
  }

  // Back to raster order: neighbours in the image are neighbours in memory.
  Corner *kept = work.kept.room_for(found);
  int64_t at = 0;
  for (int64_t i = 0; i < count; ++i) {
    const float *own = measured + 4 * i;
    if (own[2] == 0)
      continue;
    kept[at] = corners[i];
    const int64_t row = first + at++;
    out.pixels[2 * row] = own[0];
    out.pixels[2 * row + 1] = own[1];
    out.disparity_px[row] = own[2];
    out.sigma_px[row] = own[3];
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

ExtractionCounts look_at(const Look &look, const ExtractionSettings &settings,
                         const ExtractedLandmarks &out, Workspace &work) {
  ExtractionCounts counts{0, 0};
  Image level = look.left;
  for (int octave = 0; octave < settings.octaves; ++octave) {
    if (octave == 1)
      level = look.left_half;
    else if (octave > 1)
      level = halved(level, work.left_levels[octave - 1]);
    const int64_t wanted = share_up_to(octave, settings) - counts.landmarks;
    counts.landmarks += extract_octave(level, octave, wanted, look, settings.cell_px, out,
                                       counts.landmarks, &counts.corners, work);
  }
  return counts;
}

} // namespace

int64_t best_corners(const Image &image, int threshold, int64_t cell_px, int64_t most,
                     double *pixels, uint64_t *descriptors) {
  static thread_local Workspace work;
  Corner *corners = work.corners.room_for(most_corners(image.width, image.height));
  uint8_t *scores = work.scores.room_for(score_stride(image.width) * image.height);
  const int64_t count = detect_corners(image, threshold, corners, scores);
  int32_t *order = work.order.room_for(count);
  order_corners(corners, count, image, cell_px, order);
  const int64_t best = std::min(count, most);
  Corner *kept = work.kept.room_for(best);
  for (int64_t i = 0; i < best; ++i) {
    kept[i] = corners[order[i]];
    float offset[2];
    refine_corner(kept[i], scores, image.width, offset);
    pixels[2 * i] = kept[i].x + static_cast<double>(offset[0]);
    pixels[2 * i + 1] = kept[i].y + static_cast<double>(offset[1]);
  }
  uint8_t *smoothed = work.smoothed.room_for(image.width * image.height);
  smooth(image, smoothed);
  describe({smoothed, image.width, image.height}, kept, best, descriptors);
  return best;
}

ExtractionCounts extract(const Image &left, const Image &right, const Mask &mask,
                         const ExtractionSettings &settings, const ExtractedLandmarks &out) {
  static thread_local Workspace work;
  const StereoSettings &stereo = settings.stereo;
  const Image left_half = halved(left, work.left_levels[0]);
  const Image right_half = halved(right, work.right_half);
  const bool differ = settings.side_difference > 0 &&
                      side_difference(left_half, right_half, mask, stereo.max_disparity_px) > settings.side_difference;
  Look look{settings.fast_threshold,
            left,
            left_half,
            compared({left, right, left_half, right_half, differ}, work.evened),
            {},
            stereo,
            at_half_size(stereo)};
  const ExtractionCounts first = look_at(look, settings, out, work);
  if (first.landmarks == settings.landmarks || settings.second_threshold == 0)
    return first;
  look.threshold = settings.second_threshold;
  look.halved = compared({left_half, right_half, halved(left_half, work.left_levels[1]),
                          halved(right_half, work.right_quarter), differ},
                         work.evened + 2);
  return look_at(look, settings, out, work);
}

} // namespace engram::ENGRAM_ISA
