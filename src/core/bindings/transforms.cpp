#include "kernels/transforms.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <array>
#include <stdexcept>

#include "bindings/arrays.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using engram::Input;

namespace {

// Also parts of a 4×4 matrix, without a copy.
template <int dimensions>
using Strided = nb::ndarray<const double, nb::ndim<dimensions>, nb::device::cpu>;
using Transform = std::array<double, 12>;

Transform transform_from(const Strided<2> &rotation, const Strided<1> &translation) {
  if (rotation.shape(0) != 3 || rotation.shape(1) != 3 || translation.shape(0) != 3)
    throw std::invalid_argument("a transform: expected rotation (3, 3) and translation (3,)");
  Transform transform;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column)
      transform[3 * row + column] =
          rotation.data()[row * rotation.stride(0) + column * rotation.stride(1)];
    transform[9 + row] = translation.data()[row * translation.stride(0)];
  }
  return transform;
}

auto array_of(const double *from, std::initializer_list<size_t> shape) {
  size_t count = 1;
  for (const size_t length : shape)
    count *= length;
  return engram::to_numpy(std::vector<double>(from, from + count), shape);
}

const double *covariance_from(const Input<double, 2> &covariance) {
  if (covariance.shape(0) != 6 || covariance.shape(1) != 6)
    throw std::invalid_argument("expected a covariance (6, 6)");
  return covariance.data();
}

auto chain(const Strided<2> &rotation, const Strided<1> &translation,
           const Input<double, 2> &covariance, const Strided<2> &next_rotation,
           const Strided<1> &next_translation, const Input<double, 2> &next_covariance) {
  const Transform a = transform_from(rotation, translation),
                  b = transform_from(next_rotation, next_translation);
  Transform both;
  std::array<double, 36> sum;
  ENGRAM_CALL(chain, a.data(), covariance_from(covariance), b.data(),
              covariance_from(next_covariance), both.data(), sum.data());
  return nb::make_tuple(array_of(both.data(), {3, 3}), array_of(both.data() + 9, {3}),
                        array_of(sum.data(), {6, 6}));
}

auto transform_of(const Input<double, 1> &tangent) {
  if (tangent.shape(0) != 6)
    throw std::invalid_argument("expected a tangent vector (6,)");
  Transform transform;
  ENGRAM_CALL(transform_of, tangent.data(), transform.data());
  return nb::make_tuple(array_of(transform.data(), {3, 3}), array_of(transform.data() + 9, {3}));
}

constexpr double kOrigin[3] = {0, 0, 0};

auto turn_of(const Strided<2> &rotation) {
  const Transform transform = transform_from(rotation, Strided<1>(kOrigin, {3}));
  double sine, cosine;
  ENGRAM_CALL(turn_of, transform.data(), &sine, &cosine);
  return nb::make_tuple(sine, cosine);
}

auto tangent_of(const Strided<2> &rotation, const Strided<1> &translation, double angle) {
  const Transform transform = transform_from(rotation, translation);
  std::array<double, 6> tangent;
  ENGRAM_CALL(tangent_of, transform.data(), angle, tangent.data());
  return array_of(tangent.data(), {6});
}

auto orthonormalised(const Strided<2> &rotation) {
  const Transform matrix = transform_from(rotation, Strided<1>(kOrigin, {3}));
  std::array<double, 9> nearest;
  ENGRAM_CALL(orthonormalise, matrix.data(), nearest.data());
  return array_of(nearest.data(), {3, 3});
}

} // namespace

void bind_transforms(nb::module_ &module) {
  module.def("chain", &chain, "rotation"_a, "translation"_a, "covariance"_a, "next_rotation"_a,
             "next_translation"_a, "next_covariance"_a,
             "Rotation, translation and covariance (6, 6) of a_from_b @ b_from_c.");
  module.def("transform_of", &transform_of, "tangent"_a,
             "Rotation (3, 3) and translation (3,) of a tangent vector (6,).");
  module.def("turn_of", &turn_of, "rotation"_a, "Sine and cosine of a rotation's angle.");
  module.def("tangent_of", &tangent_of, "rotation"_a, "translation"_a, "angle"_a,
             "The tangent vector (6,) of a transform, its angle in [0, π].");
  module.def("orthonormalised", &orthonormalised, "rotation"_a,
             "The rotation (3, 3) next to a matrix that is nearly one.");
}
