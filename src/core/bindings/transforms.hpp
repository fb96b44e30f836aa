// Rigid transforms as 4×4 matrices of NumPy.
#pragma once

#include <vector>

#include "bindings/arrays.hpp"
#include "kernels/types.hpp"

namespace engram {

// `matrix` points at 16 numbers, row-major.
inline RigidTransform rigid_from(const double *m) {
  return {{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}, {m[3], m[7], m[11]}};
}

using Matrix = Input<double, 2>;

inline void check_shape(const Matrix &matrix, size_t rows, size_t columns, const char *message) {
  if (matrix.shape(0) != rows || matrix.shape(1) != columns)
    throw nanobind::value_error(message);
}

inline RigidTransform rigid(const Matrix &matrix) {
  check_shape(matrix, 4, 4, "a transform must have shape (4, 4)");
  return rigid_from(matrix.data());
}

inline void append_matrix(const RigidTransform &pose, std::vector<double> &values) {
  const auto &r = pose.rotation;
  const auto &t = pose.translation;
  values.insert(values.end(), {r[0], r[1], r[2], t[0], r[3], r[4], r[5], t[1], r[6], r[7], r[8],
                               t[2], 0, 0, 0, 1});
}

} // namespace engram
