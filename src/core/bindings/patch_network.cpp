#include "kernels/patch_network.hpp"

#include <algorithm>
#include <stdexcept>
#include <string>

#include "bindings/arrays.hpp"
#include "kernels/pyramid.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Image;
using engram::Input;
using Weights = nb::ndarray<const int8_t, nb::ndim<4>, nb::c_contig, nb::device::cpu>;
using Scalings = Input<int32_t, 2>;

void require(bool holds, const std::string &what) {
  if (!holds)
    throw std::invalid_argument("patch network: " + what);
}

void require_shape(const Weights &weights, int64_t outputs, int64_t side, int64_t inputs,
                   const char *name) {
  require(static_cast<int64_t>(weights.shape(0)) == outputs &&
              static_cast<int64_t>(weights.shape(1)) == side &&
              static_cast<int64_t>(weights.shape(2)) == side &&
              static_cast<int64_t>(weights.shape(3)) == inputs,
          std::string(name) + " has the wrong shape, expected (" + std::to_string(outputs) + ", " +
              std::to_string(side) + ", " + std::to_string(side) + ", " + std::to_string(inputs) +
              ")");
}

// Keeps copies of the arrays, as they come from a file, and the weights in the kernel's order.
class PatchNetwork {
public:
  PatchNetwork(const Weights &first, const Weights &second, const Weights &third,
               const Weights &linear, const Scalings &first_scaling,
               const Scalings &second_scaling, const Scalings &third_scaling,
               const Input<int32_t, 1> &thresholds, const Input<int32_t, 2> &shifts) {
    const auto &channels = engram::kPatchChannels;
    net_.bits = static_cast<int64_t>(thresholds.shape(0));
    require(net_.bits > 0 && net_.bits % 64 == 0 && net_.bits <= engram::kMostPatchBits,
            "its bits must be a multiple of 64 up to 1024");
    require_shape(first, channels[0], 5, 1, "first");
    require_shape(second, channels[1], 3, channels[0], "second");
    require_shape(third, channels[2], 3, channels[1], "third");
    require_shape(linear, net_.bits, 3, channels[2], "linear");
    require(shifts.shape(0) == 3 && shifts.shape(1) == 2, "shifts must be (3, 2)");
    const Weights *convolutions[] = {&first, &second, &third};
    const Scalings *scalings[] = {&first_scaling, &second_scaling, &third_scaling};
    for (int layer = 0; layer < 3; ++layer) {
      weights_[layer].assign(convolutions[layer]->data(),
                             convolutions[layer]->data() + convolutions[layer]->size());
      net_.convolutions[layer] = weights_[layer].data();
      take_scaling(*scalings[layer], shifts(layer, 0), shifts(layer, 1), layer);
    }
    weights_[3].assign(linear.data(), linear.data() + linear.size());
    net_.linear = weights_[3].data();
    thresholds_.assign(thresholds.data(), thresholds.data() + thresholds.size());
    net_.thresholds = thresholds_.data();
    packed_.resize(ENGRAM_CALL(packed_patch_words, net_));
    ENGRAM_CALL(pack_patch_weights, net_, packed_.data());
  }
  PatchNetwork(const PatchNetwork &) = delete;

  auto describe(const Input<uint8_t, 2> &image, const Input<float, 2> &pixels,
                const Input<uint8_t, 1> &octaves) const {
    const size_t count = pixels.shape(0);
    require(pixels.shape(1) == 2 && octaves.shape(0) == count,
            "expected pixels (N, 2) and octaves (N,)");
    const Image full{image.data(), static_cast<int64_t>(image.shape(1)),
                     static_cast<int64_t>(image.shape(0))};
    require(full.width > 0 && full.height > 0, "the image is empty");
    check_points(full, pixels, octaves);
    std::vector<uint8_t> descriptors(count * net_.bits / 8);
    {
      nb::gil_scoped_release unlocked;
      std::vector<std::vector<uint8_t>> memory;
      std::vector<Image> levels{full};
      const int deepest = count ? *std::max_element(octaves.data(), octaves.data() + count) : 0;
      for (int octave = 1; octave <= deepest; ++octave) {
        const Image &above = levels.back();
        memory.emplace_back((above.width / 2) * (above.height / 2));
        ENGRAM_CALL(halve, above, memory.back().data());
        levels.push_back({memory.back().data(), above.width / 2, above.height / 2});
      }
      ENGRAM_CALL(describe_patches, {levels.data(), static_cast<int32_t>(levels.size())},
                  pixels.data(), octaves.data(), static_cast<int64_t>(count), net_, packed_.data(),
                  descriptors.data());
    }
    return engram::to_numpy(std::move(descriptors), {count, static_cast<size_t>(net_.bits / 8)});
  }

private:
  // (outputs, 2): bias and factor. A sum times its factor, rounded, stays below 2³¹.
  void take_scaling(const Scalings &scaling, int32_t drop, int32_t shift, int layer) {
    const int outputs = engram::kPatchChannels[layer];
    require(static_cast<int>(scaling.shape(0)) == outputs && scaling.shape(1) == 2,
            "a scaling must be (" + std::to_string(outputs) + ", 2)");
    require(drop >= 0 && drop <= 15 && shift >= 1 && shift <= 30,
            "shifts must lie in 0 to 15 and 1 to 30");
    for (int output = 0; output < outputs; ++output) {
      const int32_t bias = scaling(output, 0), factor = scaling(output, 1);
      require(bias > -(1 << 29) && bias < (1 << 29) && factor >= 0 && factor < (1 << 15),
              "a bias or a factor is out of range");
      biases_[layer].push_back(bias);
      factors_[layer].push_back(factor);
    }
    net_.scalings[layer] = {biases_[layer].data(), factors_[layer].data(), drop, shift};
  }

  static void check_points(const Image &image, const Input<float, 2> &pixels,
                           const Input<uint8_t, 1> &octaves) {
    for (size_t row = 0; row < pixels.shape(0); ++row) {
      const float u = pixels(row, 0), v = pixels(row, 1);
      const int octave = octaves(row);
      require(u >= -0.5f && v >= -0.5f && u < static_cast<float>(image.width) &&
                  v < static_cast<float>(image.height),
              "a point lies outside the image");
      require(octave < 16 && (image.width >> octave) > 0 && (image.height >> octave) > 0,
              "an octave has no image");
    }
  }

  std::vector<int8_t> weights_[4];
  std::vector<int32_t> biases_[3], factors_[3], thresholds_, packed_;
  engram::PatchWeights net_{};
};

} // namespace

void bind_patch_network(nb::module_ &module) {
  nb::class_<PatchNetwork>(module, "PatchNetwork", "The network that describes patches.")
      .def(nb::init<const Weights &, const Weights &, const Weights &, const Weights &,
                    const Scalings &, const Scalings &, const Scalings &,
                    const Input<int32_t, 1> &, const Input<int32_t, 2> &>(),
           "first"_a, "second"_a, "third"_a, "linear"_a, "first_scaling"_a, "second_scaling"_a,
           "third_scaling"_a, "thresholds"_a, "shifts"_a)
      .def("describe", &PatchNetwork::describe, "image"_a, "pixels"_a, "octaves"_a,
           "Descriptors (N, bits / 8) uint8 at pixels (N, 2) float32 of an image, each at its octave.");
}
