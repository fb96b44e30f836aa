// Descriptors by a small network on the patch around each corner, in integers throughout: every
// instruction set computes the same bits. `engram_lab.fits.train_features` makes the weights.
#pragma once

#include <cstdint>

#include "dispatch.hpp"
#include "kernels/image.hpp"

namespace engram {

// 24×24 inputs, then three convolutions of stride 2, then one linear layer.
constexpr int kPatchSide = 24;
constexpr int kPatchChannels[3] = {16, 32, 48};
constexpr int kPatchLayers = 3;
constexpr int64_t kMostPatchBits = 1024;

// What makes 8 bits of a convolution's sums again, a row for each output channel:
// min(255, (clamp(sum + bias, 0, 2^(drop + 15) − 1) >> drop) · factor, rounded, >> shift); factors < 2^15.
struct PatchScaling {
  const int32_t *bias, *factor;
  int32_t drop, shift;
};

// Weights as they are stored, without padding: (outputs, rows, columns, inputs), row-major.
struct PatchWeights {
  const int8_t *convolutions[kPatchLayers]; // (16, 5, 5, 1), (32, 3, 3, 16), (48, 3, 3, 32)
  PatchScaling scalings[kPatchLayers];
  const int8_t *linear;       // (bits, 3, 3, 48)
  const int32_t *thresholds; // (bits,): a bit is set where the sum is larger
  int64_t bits;               // a multiple of 8
};

// Where patches are cut: the pyramid of an image, full size first.
struct PatchImages {
  const Image *levels;
  int32_t count;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // Number of 32-bit words of the weights in the order in which this instruction set reads them.
    int64_t packed_patch_words(const PatchWeights &weights);

    void pack_patch_weights(const PatchWeights &weights, int32_t *packed);

    // Descriptors of `bits` bits, the first bit the highest of the first byte, of points at
    // `pixels` (count, 2) of the full-size image, each at its octave < images.count.
    void describe_patches(const PatchImages &images, const float *pixels, const uint8_t *octaves,
                          int64_t count, const PatchWeights &weights, const int32_t *packed,
                          uint8_t *descriptors);)
