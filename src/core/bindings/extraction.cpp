#include "kernels/extraction.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <array>
#include <optional>
#include <stdexcept>
#include <string>

#include "bindings/arrays.hpp"
#include "kernels/brief.hpp"
#include "kernels/corners.hpp"
#include "kernels/pyramid.hpp"
#include "kernels/quantise.hpp"
#include "kernels/repeats.hpp"
#include "kernels/sides.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Corner;
using engram::Image;
using GreyImage = engram::Input<uint8_t, 2>;
using BodyMask = engram::Input<bool, 2>;
using Positions = nb::ndarray<const int16_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

constexpr int64_t longest_side_px = 32767; // positions are int16
constexpr int most_disparity_px = 500;     // the search's cost table

void require(bool holds, const std::string &what) {
  if (!holds)
    throw std::invalid_argument(what);
}

Image view(const GreyImage &array) {
  const auto height = static_cast<int64_t>(array.shape(0));
  const auto width = static_cast<int64_t>(array.shape(1));
  require(width <= longest_side_px && height <= longest_side_px,
          "an image side is longer than 32767 px");
  return {array.data(), width, height};
}

void require_same_size(const Image &left, const Image &right) {
  require(left.width == right.width && left.height == right.height,
          "left and right image differ in size");
}

// Of the left image: false on the robot's body; null without one.
const bool *seen_of(const std::optional<BodyMask> &mask, const Image &left) {
  if (!mask)
    return nullptr;
  require(static_cast<int64_t>(mask->shape(0)) == left.height &&
              static_cast<int64_t>(mask->shape(1)) == left.width,
          "mask and left image differ in size");
  return mask->data();
}

void require_disparity(int max_disparity_px) {
  require(max_disparity_px >= 1 && max_disparity_px <= most_disparity_px,
          "max_disparity_px must lie in 1 to 500");
}

void require_threshold(int threshold) {
  require(threshold >= 1 && threshold <= 254, "the FAST threshold must lie in 1 to 254");
}

std::vector<Corner> corners_inside(const Positions &positions, const Image &image) {
  std::vector<Corner> corners(positions.shape(0));
  for (size_t i = 0; i < corners.size(); ++i) {
    const int16_t x = positions(i, 0), y = positions(i, 1);
    require(x >= engram::corner_border && y >= engram::corner_border &&
                x < image.width - engram::corner_border && y < image.height - engram::corner_border,
            "a corner lies less than 17 px inside the image");
    corners[i] = {x, y, 0};
  }
  return corners;
}

engram::StereoSettings stereo_settings(int max_disparity_px, float min_disparity_px,
                                       float uniqueness, float max_residual, float max_sigma_px,
                                       float sigma_floor_px, float sigma_scale) {
  require_disparity(max_disparity_px);
  require(min_disparity_px > 0, "min_disparity_px must be above 0");
  return {max_disparity_px, min_disparity_px, uniqueness, max_residual,
          max_sigma_px,     sigma_floor_px,   sigma_scale};
}

auto detect_corners(const GreyImage &array, int threshold) {
  const Image image = view(array);
  require_threshold(threshold);
  std::vector<Corner> corners(engram::most_corners(image.width, image.height));
  std::vector<uint8_t> map(engram::score_stride(image.width) * image.height), scores;
  std::vector<int16_t> positions;
  std::vector<float> offsets;
  {
    nb::gil_scoped_release unlocked;
    corners.resize(ENGRAM_CALL(detect_corners, image, threshold, corners.data(), map.data()));
    for (const Corner &corner : corners) {
      positions.insert(positions.end(), {corner.x, corner.y});
      scores.push_back(corner.score);
      float offset[2];
      ENGRAM_CALL(refine_corner, corner, map.data(), image.width, offset);
      offsets.insert(offsets.end(), {offset[0], offset[1]});
    }
  }
  const size_t count = corners.size();
  return nb::make_tuple(engram::to_numpy(std::move(positions), {count, 2}),
                        engram::to_numpy(std::move(scores), {count}),
                        engram::to_numpy(std::move(offsets), {count, 2}));
}

auto equal_pixels(const GreyImage &now_array, const GreyImage &before_array, uint8_t black,
                  uint8_t white) {
  const Image now = view(now_array), before = view(before_array);
  require_same_size(now, before);
  engram::EqualPixels found;
  {
    nb::gil_scoped_release unlocked;
    found = ENGRAM_CALL(equal_pixels, now, before, black, white);
  }
  return nb::make_tuple(found.telling, found.equal);
}

auto best_corners(const GreyImage &array, int threshold, int cell_px, int most) {
  const Image image = view(array);
  require_threshold(threshold);
  require(cell_px >= 4 && most >= 1, "cell_px must be at least 4, most at least 1");
  const auto room = static_cast<size_t>(most);
  std::vector<double> pixels(2 * room);
  std::vector<uint8_t> descriptors(32 * room);
  size_t count;
  {
    nb::gil_scoped_release unlocked;
    count = static_cast<size_t>(ENGRAM_CALL(best_corners, image, threshold, cell_px, most,
                                            pixels.data(),
                                            reinterpret_cast<uint64_t *>(descriptors.data())));
  }
  return nb::make_tuple(engram::to_numpy(std::move(pixels), {count, 2}),
                        engram::to_numpy(std::move(descriptors), {count, 32}));
}

auto order_corners(const Positions &positions, const engram::Input<uint8_t, 1> &scores, int width,
                   int height, int cell_px) {
  require(positions.shape(0) == scores.shape(0), "positions and scores differ in number");
  require(cell_px >= 4, "cell_px must be at least 4");
  const Image image{nullptr, width, height};
  std::vector<Corner> corners = corners_inside(positions, image);
  for (size_t i = 0; i < corners.size(); ++i)
    corners[i].score = scores(i);
  std::vector<int32_t> order(corners.size());
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(order_corners, corners.data(), static_cast<int64_t>(corners.size()), image, cell_px,
                order.data());
  }
  const size_t count = order.size();
  return engram::to_numpy(std::move(order), {count});
}

auto smooth(const GreyImage &array) {
  const Image image = view(array);
  std::vector<uint8_t> smoothed(array.size());
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(smooth, image, smoothed.data());
  }
  return engram::to_numpy(std::move(smoothed), {array.shape(0), array.shape(1)});
}

std::vector<uint8_t> half_of(const Image &image) {
  std::vector<uint8_t> half((image.width / 2) * (image.height / 2));
  ENGRAM_CALL(halve, image, half.data());
  return half;
}

auto halve(const GreyImage &array) {
  const Image image = view(array);
  std::vector<uint8_t> half;
  {
    nb::gil_scoped_release unlocked;
    half = half_of(image);
  }
  return engram::to_numpy(std::move(half), {array.shape(0) / 2, array.shape(1) / 2});
}

auto describe(const GreyImage &smoothed, const Positions &positions) {
  const Image image = view(smoothed);
  const std::vector<Corner> corners = corners_inside(positions, image);
  const size_t count = corners.size();
  std::vector<uint8_t> descriptors(32 * count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(describe, image, corners.data(), static_cast<int64_t>(count),
                reinterpret_cast<uint64_t *>(descriptors.data()));
  }
  return engram::to_numpy(std::move(descriptors), {count, 32});
}

auto measure_disparities(const GreyImage &left_array, const GreyImage &right_array,
                         const Positions &positions, int max_disparity_px, float min_disparity_px,
                         float uniqueness, float max_residual, float max_sigma_px,
                         float sigma_floor_px, float sigma_scale, bool sides_differ) {
  const Image left = view(left_array), right = view(right_array);
  require_same_size(left, right);
  const auto settings = stereo_settings(max_disparity_px, min_disparity_px, uniqueness,
                                        max_residual, max_sigma_px, sigma_floor_px, sigma_scale);
  const std::vector<Corner> corners = corners_inside(positions, left);
  const size_t count = corners.size();
  std::vector<float> disparities(count), sigmas(count);
  {
    nb::gil_scoped_release unlocked;
    std::vector<uint8_t> left_half = half_of(left), right_half = half_of(right);
    const Image halves[] = {{left_half.data(), left.width / 2, left.height / 2},
                            {right_half.data(), left.width / 2, left.height / 2}};
    if (sides_differ) {
      const std::vector<uint8_t> given[] = {left_half, right_half};
      for (const int side : {0, 1})
        ENGRAM_CALL(even_contrast, {given[side].data(), halves[side].width, halves[side].height},
                    side == 0 ? left_half.data() : right_half.data());
    }
    const engram::StereoImages images{left, right, halves[0], halves[1], sides_differ};
    for (size_t i = 0; i < count; ++i)
      if (!ENGRAM_CALL(measure_disparity, images, corners[i].x, corners[i].y, settings,
                       &disparities[i], &sigmas[i]))
        disparities[i] = sigmas[i] = 0;
  }
  return nb::make_tuple(engram::to_numpy(std::move(disparities), {count}),
                        engram::to_numpy(std::move(sigmas), {count}));
}

auto extract(const GreyImage &left_array, const GreyImage &right_array, int landmarks, int octaves,
             int fast_threshold, int cell_px, bool with_descriptors, int max_disparity_px,
             float min_disparity_px, float uniqueness, float max_residual, float max_sigma_px,
             float sigma_floor_px, float sigma_scale, int second_threshold, float side_difference,
             const std::optional<BodyMask> &mask) {
  const Image left = view(left_array), right = view(right_array);
  require_same_size(left, right);
  const bool *seen = seen_of(mask, left);
  require(second_threshold >= 0 && second_threshold <= 254,
          "second_threshold must lie in 0 to 254");
  require(landmarks >= 1 && landmarks <= 1'000'000, "landmarks must lie in 1 to 1000000");
  require(octaves >= 1 && octaves <= engram::most_octaves, "octaves must lie in 1 to 4");
  require(cell_px >= 4, "cell_px must be at least 4");
  require_threshold(fast_threshold);
  const engram::ExtractionSettings settings{
      landmarks, octaves, fast_threshold, cell_px, second_threshold, side_difference,
      stereo_settings(max_disparity_px, min_disparity_px, uniqueness, max_residual, max_sigma_px,
                      sigma_floor_px, sigma_scale)};
  const auto room = static_cast<size_t>(landmarks);
  std::vector<float> pixels(2 * room), disparities(room), sigmas(room);
  std::vector<uint8_t> descriptors(with_descriptors ? 32 * room : 0), levels(room);
  engram::ExtractionCounts counts;
  {
    nb::gil_scoped_release unlocked;
    counts = ENGRAM_CALL(
        extract, left, right, {seen, left.width, left.height}, settings,
        {pixels.data(), disparities.data(), sigmas.data(),
         with_descriptors ? reinterpret_cast<uint64_t *>(descriptors.data()) : nullptr,
         levels.data()});
  }
  const auto count = static_cast<size_t>(counts.landmarks);
  return nb::make_tuple(engram::to_numpy(std::move(pixels), {count, 2}),
                        engram::to_numpy(std::move(disparities), {count}),
                        engram::to_numpy(std::move(sigmas), {count}),
                        engram::to_numpy(std::move(descriptors), {with_descriptors ? count : 0, 32}),
                        engram::to_numpy(std::move(levels), {count}), counts.corners);
}

float side_difference(const GreyImage &left_array, const GreyImage &right_array,
                      int max_disparity_px, const std::optional<BodyMask> &mask) {
  const Image left = view(left_array), right = view(right_array);
  require_same_size(left, right);
  require_disparity(max_disparity_px);
  const bool *seen = seen_of(mask, left);
  nb::gil_scoped_release unlocked;
  const std::vector<uint8_t> left_half = half_of(left), right_half = half_of(right);
  return ENGRAM_CALL(side_difference, {left_half.data(), left.width / 2, left.height / 2},
                     {right_half.data(), left.width / 2, left.height / 2},
                     {seen, left.width, left.height}, max_disparity_px);
}

auto even_contrast(const GreyImage &array) {
  const Image image = view(array);
  std::vector<uint8_t> evened(array.size());
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(even_contrast, image, evened.data());
  }
  return engram::to_numpy(std::move(evened), {array.shape(0), array.shape(1)});
}

// Of any detector's keypoints, ours or another's.
nb::object quantise_landmarks(const engram::Input<float, 2> &pixels,
                              const engram::Input<float, 1> &disparities,
                              const engram::Input<float, 1> &sigmas, float quantum_px,
                              const engram::Input<float, 1> &sigma_table,
                              const engram::Input<float, 1> &sigma_borders,
                              const std::array<double, 5> &camera) {
  const size_t count = pixels.shape(0);
  require(pixels.shape(1) == 2 && disparities.shape(0) == count && sigmas.shape(0) == count,
          "pixels (N, 2), disparities (N,) and their sigmas (N,) are needed");
  require(sigma_table.shape(0) == sigma_borders.shape(0) + 1 && sigma_borders.shape(0) > 0,
          "between two values of sigma lies one border");
  std::vector<float> seen(pixels.data(), pixels.data() + 2 * count), points(3 * count);
  std::vector<float> disparity(disparities.data(), disparities.data() + count);
  std::vector<float> sigma(sigmas.data(), sigmas.data() + count);
  bool fits;
  {
    nb::gil_scoped_release unlocked;
    fits = ENGRAM_CALL(quantise_landmarks,
                       {static_cast<int64_t>(count), seen.data(), disparity.data(), sigma.data(),
                        points.data()},
                       {quantum_px, sigma_table.data(), sigma_borders.data(),
                        static_cast<int>(sigma_table.shape(0))},
                       {camera[0], camera[1], camera[2], camera[3], camera[4]});
  }
  if (!fits)
    return nb::none();
  return nb::make_tuple(engram::to_numpy(std::move(seen), {count, 2}),
                        engram::to_numpy(std::move(disparity), {count}),
                        engram::to_numpy(std::move(sigma), {count}),
                        engram::to_numpy(std::move(points), {count, 3}));
}

// The image, halved until it is at most so wide.
auto thumbnail(const GreyImage &array, int width_px) {
  Image image = view(array);
  require(width_px >= 1, "width_px must be at least 1");
  std::vector<uint8_t> small;
  {
    nb::gil_scoped_release unlocked;
    while (image.width > width_px && image.height > 1) {
      std::vector<uint8_t> half = half_of(image);
      small.swap(half);
      image = {small.data(), image.width / 2, image.height / 2};
    }
    if (small.empty())
      small.assign(image.pixels, image.pixels + image.width * image.height);
  }
  return engram::to_numpy(std::move(small), {static_cast<size_t>(image.height),
                                             static_cast<size_t>(image.width)});
}

} // namespace

void bind_extraction(nb::module_ &module) {
  module.def("detect_corners", &detect_corners, "image"_a, "threshold"_a,
             "FAST-9 corners: positions (N, 2) int16 x, y in raster order, scores (N,) uint8, "
             "sub-pixel offsets (N, 2) float32.");
  module.def("equal_pixels", &equal_pixels, "now"_a, "before"_a, "black"_a, "white"_a,
             "Pixels between black and white, and how many of them are equal.");
  module.def("best_corners", &best_corners, "image"_a, "threshold"_a, "cell_px"_a, "most"_a,
             "The first corners in their order: pixels (N, 2) float64, BRIEF-256 (N, 32) uint8.");
  module.def("order_corners", &order_corners, "positions"_a, "scores"_a, "width"_a, "height"_a,
             "cell_px"_a, "Indices (N,) int32: best corner of each cell first, then the second.");
  module.def("smooth", &smooth, "image"_a, "Binomial 5×5 blur; the outer two pixels are zero.");
  module.def("halve", &halve, "image"_a, "Mean of 2×2 pixels, rounded half up.");
  module.def("side_difference", &side_difference, "left"_a, "right"_a, "max_disparity_px"_a,
             "mask"_a = nb::none(),
             "By how much the sides differ in brightness and contrast, as a share of the contrast.");
  module.def("even_contrast", &even_contrast, "image"_a,
             "The image freed of local brightness and contrast.");
  module.def("describe", &describe, "smoothed"_a, "positions"_a,
             "BRIEF-256 (N, 32) uint8 at corners (N, 2) int16 of a smoothed image.");
  module.def("measure_disparities", &measure_disparities, "left"_a, "right"_a, "positions"_a,
             "max_disparity_px"_a, "min_disparity_px"_a, "uniqueness"_a, "max_residual"_a, "max_sigma_px"_a,
             "sigma_floor_px"_a, "sigma_scale"_a, "sides_differ"_a = false,
             "Disparities and σ (N,) float32 px at corners (N, 2) int16; 0 where there is none.");
  module.def("quantise_landmarks", &quantise_landmarks, "pixels"_a, "disparity_px"_a, "sigma_px"_a,
             "quantum_px"_a, "sigma_table"_a, "sigma_borders"_a, "camera"_a,
             "Pixels (N, 2), disparities (N,) and σ (N,) as their codes have them, and points "
             "(N, 3), all float32; None where one has no code. Camera: fx, fy, cx, cy, baseline.");
  module.def("thumbnail", &thumbnail, "image"_a, "width_px"_a,
             "The image, halved until it is at most width_px wide.");
  module.def("extract", &extract, "left"_a, "right"_a, "landmarks"_a, "octaves"_a,
             "fast_threshold"_a, "cell_px"_a, "with_descriptors"_a, "max_disparity_px"_a,
             "min_disparity_px"_a, "uniqueness"_a, "max_residual"_a, "max_sigma_px"_a, "sigma_floor_px"_a,
             "sigma_scale"_a, "second_threshold"_a = 0, "side_difference"_a = 0, "mask"_a = nb::none(),
             "Stereo pair → pixels (N, 2), disparities, σ (N,) float32, descriptors (N, 32), "
             "octaves (N,) uint8, number of corners.");
}
