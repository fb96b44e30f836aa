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

inline void append_matrix(const RigidTransform &pose, std::vector<double> &values) {
  const auto &r = pose.rotation;
  const auto &t = pose.translation;
  values.insert(values.end(), {r[0], r[1], r[2], t[0], r[3], r[4], r[5], t[1], r[6], r[7], r[8],
                               t[2], 0, 0, 0, 1});
}

} // namespace engram
