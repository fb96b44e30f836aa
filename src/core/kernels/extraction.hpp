// The front-end's hot path in one call: stereo pair → landmarks.
#pragma once

#include "dispatch.hpp"
#include "kernels/disparity.hpp"
#include "kernels/image.hpp"

namespace engram {

constexpr int32_t most_octaves = 4;

struct ExtractionSettings {
  int32_t landmarks; // at most so many, all octaves together
  int32_t octaves;   // 1 to most_octaves, each half the size of the one before
  int32_t fast_threshold, cell_px;
  int32_t second_threshold; // of the second look; 0: none
  float side_difference; // beyond which the sides are compared free of brightness; 0: never
  StereoSettings stereo;
};

// Where the landmarks go: room for ExtractionSettings::landmarks each.
struct ExtractedLandmarks {
  float *pixels; // u, v of the full-size left image
  float *disparity_px, *sigma_px;
  uint64_t *descriptors; // four words each; may be null: not computed
  uint8_t *octaves;
};

struct ExtractionCounts {
  int64_t landmarks, corners;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // Octave by octave: corners, in the order of order_corners(), are given a disparity until the
    // octave's share of landmarks is reached; what an octave leaves over goes to the next. Shares
    // fall with the octave's scale, 1 : 1/2 : 1/4 …. Landmarks come out by octave, in raster order.
    //
    // Where that gives fewer than were asked for, a second look replaces it: corners above the
    // second threshold, and what has no disparity in the images is given one in the halved images,
    // where windows are twice as large and a blur is half as wide. Drops on a lens, fog and the
    // dark leave few corners, and those are often sharp in one image only.
    //
    // Where the sides differ in brightness or contrast, disparities are measured free of both;
    // other pairs get the same bits as without that. The mask tells what of the left image is not
    // to be asked whether they differ.
    ExtractionCounts extract(const Image &left, const Image &right, const Mask &mask,
                             const ExtractionSettings &settings, const ExtractedLandmarks &out);

    // The first `most` corners of an image in the order of order_corners(), with fractions of a
    // pixel, and their descriptors of four words. Returns how many there are.
    int64_t best_corners(const Image &image, int threshold, int64_t cell_px, int64_t most,
                         double *pixels, uint64_t *descriptors);)
