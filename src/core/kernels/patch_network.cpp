#include "kernels/patch_network.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include "kernels/buffer.hpp"

namespace engram::ENGRAM_ISA {
namespace {

// Patches stand side by side, one per 32-bit lane; each lane holds kGroup neighbouring values:
// four bytes where the machine adds four products at once, else two 16-bit numbers.
#if defined(__AVX512VNNI__)
constexpr int kGroup = 4;
#else
constexpr int kGroup = 2;
#endif
constexpr int kValueBits = 32 / kGroup;

#if defined(__AVX512BW__)
constexpr int kNative = 16, kPatches = 32, kBlock = 8; // outputs that share a pass
#elif defined(__AVX2__)
constexpr int kNative = 8, kPatches = 16, kBlock = 4;
#else
constexpr int kNative = 4, kPatches = 16, kBlock = 2;
#endif
typedef int32_t Native __attribute__((vector_size(4 * kNative)));
constexpr int kParts = kPatches / kNative;

struct Lanes {
  Native part[kParts];
};

// Adds the products of a group of values with a group of weights.
inline Native add_products(Native sum, Native values, int32_t weights) {
#if defined(__AVX512VNNI__)
  return (Native)_mm512_dpbusd_epi32((__m512i)sum, (__m512i)values, _mm512_set1_epi32(weights));
#elif defined(__AVX512BW__)
  return sum + (Native)_mm512_madd_epi16((__m512i)values, _mm512_set1_epi32(weights));
#elif defined(__AVX2__)
  return sum + (Native)_mm256_madd_epi16((__m256i)values, _mm256_set1_epi32(weights));
#elif defined(__SSE2__)
  return sum + (Native)_mm_madd_epi16((__m128i)values, _mm_set1_epi32(weights));
#else
  const auto low = static_cast<int16_t>(weights), high = static_cast<int16_t>(weights >> 16);
  return sum + (values & 0xffff) * low + (values >> 16) * high; // values are never negative
#endif
}

// Keeps a running sum in its register: without it the compiler sums several groups at once, has
// more partial sums than registers, and the generic code takes five times as long.
inline Native in_register(Native sum) {
#if defined(__AVX512F__)
  asm("" : "+v"(sum));
#elif defined(__SSE2__)
  asm("" : "+x"(sum));
#elif defined(__aarch64__)
  asm("" : "+w"(sum));
#endif
  return sum;
}

inline int32_t grouped(const int8_t *weights, int count) {
  uint32_t word = 0;
  for (int k = 0; k < count; ++k)
    word |= (static_cast<uint32_t>(weights[k]) & ((1ull << kValueBits) - 1)) << (kValueBits * k);
  return static_cast<int32_t>(word);
}

// The first convolution reads 5×5 values from even rows and columns on: four columns in groups along
// the rows, four of the fifth column in groups along it, and the last one by itself.
constexpr int kSide = 5, kFourths = 4 / kGroup, kGroupStep = kGroup / 2;
constexpr int kPadded = kPatchSide + 4, kColumns = kPadded / 2;
constexpr int32_t kZero = 128; // the input's middle

constexpr int kC1 = kPatchChannels[0], kC2 = kPatchChannels[1], kC3 = kPatchChannels[2];
constexpr int kSide1 = kPatchSide / 2, kSide2 = kSide1 / 2, kSide3 = kSide2 / 2;
constexpr int kTaps[4] = {(kSide + 1) * kFourths + 1, 9 * kC1 / kGroup, 9 * kC2 / kGroup, 9 * kC3 / kGroup};

inline int64_t words_before(int layer) {
  int64_t words = 0;
  for (int k = 0; k < layer; ++k)
    words += static_cast<int64_t>(kTaps[k]) * kPatchChannels[k];
  return words;
}

// (outputs, taps · group) bytes → blocks of kBlock outputs, in each the taps, in each the outputs.
int32_t *pack_layer(const int8_t *weights, int64_t outputs, int inputs, int rows, int32_t *packed) {
  const int groups = (inputs + kGroup - 1) / kGroup;
  for (int64_t block = 0; block < outputs; block += kBlock)
    for (int row = 0; row < rows; ++row)
      for (int group = 0; group < groups; ++group)
        for (int64_t output = block; output < block + kBlock; ++output) {
          const int8_t *from = weights + (output * rows + row) * inputs + group * kGroup;
          *packed++ = grouped(from, std::min(kGroup, inputs - group * kGroup));
        }
  return packed;
}

// The first layer's (outputs, 5, 5) bytes, in the same blocks.
int32_t *pack_first(const int8_t *weights, int32_t *packed) {
  for (int block = 0; block < kC1; block += kBlock) {
    const auto each = [&](int row, int column, int step, int count) {
      for (int output = block; output < block + kBlock; ++output) {
        int8_t group[kGroup];
        for (int k = 0; k < count; ++k)
          group[k] = weights[(output * kSide + row) * kSide + column + k * step];
        *packed++ = grouped(group, count);
      }
    };
    for (int row = 0; row < kSide; ++row)
      for (int column = 0; column < 4; column += kGroup)
        each(row, column, 1, kGroup);
    for (int row = 0; row < 4; row += kGroup)
      each(row, 4, kSide, kGroup);
    each(4, 4, 1, 1);
  }
  return packed;
}

// The pixel of an octave's image nearest to a point of the full-size one, ties to even.
inline int64_t at_level(float coordinate, int octave) {
  const float scale = 1.0f / static_cast<float>(1 << octave);
  return static_cast<int64_t>(std::nearbyint((coordinate + 0.5f) * scale - 0.5f));
}

// The 48×48 pixels around (x, y); those beyond the image repeat its edge. Gives their row length.
inline const uint8_t *around(const Image &image, int64_t x, int64_t y, uint8_t *copy,
                             int64_t *stride) {
  const int64_t left = x - kPatchSide, top = y - kPatchSide;
  if (left >= 0 && top >= 0 && left + 2 * kPatchSide <= image.width &&
      top + 2 * kPatchSide <= image.height) {
    *stride = image.width;
    return image.pixels + top * image.width + left;
  }
  *stride = 2 * kPatchSide;
  for (int64_t row = 0; row < 2 * kPatchSide; ++row) {
    const uint8_t *from =
        image.pixels + std::clamp<int64_t>(top + row, 0, image.height - 1) * image.width;
    for (int64_t column = 0; column < 2 * kPatchSide; ++column)
      copy[row * 2 * kPatchSide + column] =
          from[std::clamp<int64_t>(left + column, 0, image.width - 1)];
  }
  return copy;
}

// Sums of 2×2 pixels, less their mean, 24 units to a standard deviation plus two grey levels:
// v · factor − offset in 16 bits behind the point.
void normalise(const uint8_t *pixels, int64_t stride, uint8_t *out) {
  constexpr int kCount = kPatchSide * kPatchSide;
  int16_t sums[kCount];
  for (int y = 0; y < kPatchSide; ++y) {
    uint16_t upper[kPatchSide], lower[kPatchSide]; // two pixels each
    std::memcpy(upper, pixels + 2 * y * stride, sizeof upper);
    std::memcpy(lower, pixels + (2 * y + 1) * stride, sizeof lower);
    for (int x = 0; x < kPatchSide; ++x)
      sums[y * kPatchSide + x] = static_cast<int16_t>((upper[x] & 255) + (upper[x] >> 8) +
                                                      (lower[x] & 255) + (lower[x] >> 8));
  }
  int32_t total = 0, squares = 0;
  for (const int16_t sum : sums) {
    total += sum;
    squares += int32_t{sum} * sum; // ≤ 576 · 1020² < 2³⁰
  }
  const int64_t variance =
      static_cast<int64_t>(kCount) * squares - static_cast<int64_t>(total) * total;
  // Below 2³⁹: a double holds it, and its root is rounded alike everywhere.
  const int64_t divisor =
      static_cast<int64_t>(std::sqrt(static_cast<double>(variance))) + 2 * 4 * kCount;
  const auto factor = static_cast<int32_t>((int64_t{24 * kCount} << 16) / divisor);
  const auto offset = static_cast<int32_t>((int64_t{24} * total << 16) / divisor);
  for (int k = 0; k < kCount; ++k) {
    const int32_t value = kZero + ((sums[k] * factor - offset + (1 << 15)) >> 16);
    out[k] = static_cast<uint8_t>(std::clamp(value, 0, 255));
  }
}

// At (y, x) the kGroup values of row y from column 2x on; at (y, x) those of column 2x + 4 from row
// 2y on.
typedef Lanes Input[kPadded][kColumns];
typedef Lanes Columns[kSide1 + 1][kSide1];

typedef uint8_t Patch[kPatchSide * kPatchSide];

// Puts patches into their lanes, row by row: the lanes' words of one row are near in memory.
void place(const Patch *patches, int64_t count, Input &input) {
  for (int y = 0; y < kPatchSide; ++y)
    for (int64_t lane = 0; lane < count; ++lane) {
      uint8_t row[kPadded + 2];
      std::memset(row, kZero, sizeof row);
      std::memcpy(row + 2, patches[lane] + y * kPatchSide, kPatchSide);
      auto *to = reinterpret_cast<int32_t *>(input[y + 2]) + lane;
      for (int x = 0; x < kColumns; ++x) {
        uint32_t word = 0;
        for (int k = 0; k < kGroup; ++k)
          word |= static_cast<uint32_t>(row[2 * x + k]) << (kValueBits * k);
        std::memcpy(to + x * kPatches, &word, 4);
      }
    }
}

void clear(Input &input) {
  for (auto &row : input)
    for (Lanes &lanes : row)
      for (Native &part : lanes.part) {
        uint32_t word = 0;
        for (int k = 0; k < kGroup; ++k)
          word |= static_cast<uint32_t>(kZero) << (kValueBits * k);
        part = Native{} + static_cast<int32_t>(word);
      }
}

void take_columns(const Input &input, Columns &columns) {
  constexpr int32_t kOne = (1 << kValueBits) - 1;
  for (int y = 0; y < kSide1 + (kGroup == 2); ++y) // pairs go on to the row below the last
    for (int x = 0; x < kSide1; ++x)
      for (int part = 0; part < kParts; ++part) {
        Native word{};
        for (int k = 0; k < kGroup; ++k)
          word |= (input[2 * y + k][x + 2].part[part] & kOne) << (kValueBits * k);
        columns[y][x].part[part] = word;
      }
}

struct Sums {
  Lanes of[kBlock];
};

inline Sums starting_at(const int32_t *values) {
  Sums sums;
  for (int output = 0; output < kBlock; ++output)
    for (Native &part : sums.of[output].part)
      part = Native{} + values[output];
  return sums;
}

inline void add_group(Sums &sums, const Lanes &values, const int32_t *weights) {
#pragma GCC unroll 16
  for (int output = 0; output < kBlock; ++output)
#pragma GCC unroll 4
    for (int part = 0; part < kParts; ++part) {
      const Native sum = sums.of[output].part[part];
      sums.of[output].part[part] =
          in_register(add_products(sum, values.part[part], weights[output]));
    }
}

// value · factor + more, both factors in 0 … 2¹⁵ − 1.
inline Native scaled(Native value, int32_t factor, int32_t more) {
#if defined(__AVX512VNNI__)
  return (Native)_mm512_dpwssd_epi32(_mm512_set1_epi32(more), (__m512i)value,
                                     _mm512_set1_epi32(factor));
#elif defined(__AVX512BW__)
  return (Native)_mm512_madd_epi16((__m512i)value, _mm512_set1_epi32(factor)) + more;
#elif defined(__AVX2__)
  return (Native)_mm256_madd_epi16((__m256i)value, _mm256_set1_epi32(factor)) + more;
#elif defined(__SSE2__)
  return (Native)_mm_madd_epi16((__m128i)value, _mm_set1_epi32(factor)) + more;
#else
  return value * factor + more;
#endif
}

// A sum that began at its channel's bias, in 8 bits.
inline Native rescaled(Native value, const PatchScaling &scaling, int channel) {
  const Native zero{}, most = zero + ((1 << (scaling.drop + 15)) - 1), full = zero + 255;
  value = value < zero ? zero : value;
  value = value > most ? most : value;
  value = scaled(value >> scaling.drop, scaling.factor[channel], 1 << (scaling.shift - 1)) >>
          scaling.shift;
  return value > full ? full : value;
}

// The block's outputs in 8 bits, grouped, from `first` on.
inline void emit(const Sums &sums, const PatchScaling &scaling, int first, Lanes *out) {
  for (int output = 0; output < kBlock; output += kGroup)
    for (int part = 0; part < kParts; ++part) {
      Native word{};
#pragma GCC unroll 4
      for (int k = 0; k < kGroup; ++k)
        word |= rescaled(sums.of[output + k].part[part], scaling, first + output + k)
                << (kValueBits * k);
      out[(first + output) / kGroup].part[part] = word;
    }
}

void first_convolution(const Input &input, const Columns &columns, const int32_t *weights,
                       const PatchScaling &scaling, Lanes *out) {
  for (int block = 0; block < kC1; block += kBlock, weights += kTaps[0] * kBlock)
    for (int y = 0; y < kSide1; ++y)
      for (int x = 0; x < kSide1; ++x) {
        Sums sums = starting_at(scaling.bias + block);
        const int32_t *own = weights;
        for (int row = 0; row < kSide; ++row)
#pragma GCC unroll 2
          for (int group = 0; group < kFourths; ++group, own += kBlock)
            add_group(sums, input[2 * y + row][x + group * kGroupStep], own);
#pragma GCC unroll 2
        for (int group = 0; group < kFourths; ++group, own += kBlock)
          add_group(sums, columns[y + group][x], own);
        add_group(sums, input[2 * y + 4][x + 2], own);
        emit(sums, scaling, block, out + (y * kSide1 + x) * (kC1 / kGroup));
      }
}

// 3×3, stride 2, one row and column of zeros around the input, which are left out.
template <int inputs, int outputs, int side>
void convolution(const Lanes *input, const int32_t *weights, const PatchScaling &scaling,
                 Lanes *out) {
  constexpr int groups = inputs / kGroup;
  for (int block = 0; block < outputs; block += kBlock, weights += 9 * groups * kBlock)
    for (int y = 0; y < side / 2; ++y)
      for (int x = 0; x < side / 2; ++x) {
        Sums sums = starting_at(scaling.bias + block);
        for (int tap = 0; tap < 9; ++tap) {
          const int row = 2 * y + tap / 3 - 1, column = 2 * x + tap % 3 - 1;
          if (row < 0 || column < 0)
            continue;
          const Lanes *from = input + (row * side + column) * groups;
          const int32_t *own = weights + tap * groups * kBlock;
          for (int group = 0; group < groups; ++group, own += kBlock)
            add_group(sums, from[group], own);
        }
        emit(sums, scaling, block, out + (y * (side / 2) + x) * (outputs / kGroup));
      }
}

// One bit of each output of the linear layer, into the descriptors of `count` patches.
void signs(const Lanes *input, const int32_t *weights, const PatchWeights &net, int64_t count,
           uint8_t *descriptors) {
  const int64_t bytes = net.bits / 8;
  for (int64_t byte = 0; byte < bytes; ++byte) {
    Lanes word{};
    for (int first = 0; first < 8; first += kBlock) {
      Sums sums{};
      for (int tap = 0; tap < kTaps[3]; ++tap, weights += kBlock)
        add_group(sums, input[tap], weights);
#pragma GCC unroll 8
      for (int output = 0; output < kBlock; ++output)
        for (int part = 0; part < kParts; ++part) {
          const Native least = Native{} + net.thresholds[8 * byte + first + output];
          word.part[part] |=
              (sums.of[output].part[part] > least) & (Native{} + (128 >> (first + output)));
        }
    }
    int32_t values[kPatches];
    std::memcpy(values, &word, sizeof values);
    for (int64_t patch = 0; patch < count; ++patch)
      descriptors[patch * bytes + byte] = static_cast<uint8_t>(values[patch]);
  }
}

struct Layers {
  Input input;
  Columns columns;
  Lanes first[kSide1 * kSide1 * kC1 / kGroup], second[kSide2 * kSide2 * kC2 / kGroup],
      third[kSide3 * kSide3 * kC3 / kGroup];
  Patch patches[kPatches];
};

} // namespace

int64_t packed_patch_words(const PatchWeights &weights) {
  return words_before(kPatchLayers) + static_cast<int64_t>(kTaps[3]) * weights.bits;
}

void pack_patch_weights(const PatchWeights &weights, int32_t *packed) {
  packed = pack_first(weights.convolutions[0], packed);
  packed = pack_layer(weights.convolutions[1], kC2, kC1, 9, packed);
  packed = pack_layer(weights.convolutions[2], kC3, kC2, 9, packed);
  pack_layer(weights.linear, weights.bits, kC3, 9, packed);
}

void describe_patches(const PatchImages &images, const float *pixels, const uint8_t *octaves,
                      int64_t count, const PatchWeights &weights, const int32_t *packed,
                      uint8_t *descriptors) {
  static thread_local Buffer<uint8_t> memory;
  uint8_t *start = memory.room_for(sizeof(Layers) + 64);
  start += (64 - reinterpret_cast<uintptr_t>(start) % 64) % 64;
  auto &layers = *reinterpret_cast<Layers *>(start);
  clear(layers.input);
  for (int64_t first = 0; first < count; first += kPatches) {
    const int64_t here = std::min<int64_t>(kPatches, count - first);
    for (int64_t k = 0; k < here; ++k) {
      const int64_t row = first + k;
      const int octave = octaves[row];
      uint8_t copy[4 * kPatchSide * kPatchSide];
      int64_t stride;
      const uint8_t *cut =
          around(images.levels[octave], at_level(pixels[2 * row], octave),
                 at_level(pixels[2 * row + 1], octave), copy, &stride);
      normalise(cut, stride, layers.patches[k]);
    }
    place(layers.patches, here, layers.input);
    take_columns(layers.input, layers.columns);
    first_convolution(layers.input, layers.columns, packed, weights.scalings[0], layers.first);
    convolution<kC1, kC2, kSide1>(layers.first, packed + words_before(1), weights.scalings[1],
                                  layers.second);
    convolution<kC2, kC3, kSide2>(layers.second, packed + words_before(2), weights.scalings[2],
                                  layers.third);
    signs(layers.third, packed + words_before(3), weights, here,
          descriptors + first * (weights.bits / 8));
  }
}

} // namespace engram::ENGRAM_ISA
