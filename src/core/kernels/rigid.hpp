// Rigid transforms and small symmetric systems. No function of libm but sqrt, which IEEE 754 fixes
// to the last bit: results do not depend on the machine.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

#include "kernels/types.hpp"

namespace engram::ENGRAM_ISA {

using Vec3 = std::array<double, 3>;

inline Vec3 operator+(const Vec3 &a, const Vec3 &b) {
  return {a[0] + b[0], a[1] + b[1], a[2] + b[2]};
}
inline Vec3 operator-(const Vec3 &a, const Vec3 &b) {
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}
inline Vec3 operator*(double scale, const Vec3 &a) {
  return {scale * a[0], scale * a[1], scale * a[2]};
}
inline double dot(const Vec3 &a, const Vec3 &b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double norm(const Vec3 &a) { return std::sqrt(dot(a, a)); }
inline Vec3 cross(const Vec3 &a, const Vec3 &b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// target_from_source: points_in_target = R points_in_source + t, R row-major.
using Pose = RigidTransform;

inline Vec3 rotate(const Pose &pose, const Vec3 &p) {
  const auto &r = pose.rotation;
  return {r[0] * p[0] + r[1] * p[1] + r[2] * p[2], r[3] * p[0] + r[4] * p[1] + r[5] * p[2],
          r[6] * p[0] + r[7] * p[1] + r[8] * p[2]};
}

inline Vec3 rotate_back(const Pose &pose, const Vec3 &p) {
  const auto &r = pose.rotation;
  return {r[0] * p[0] + r[3] * p[1] + r[6] * p[2], r[1] * p[0] + r[4] * p[1] + r[7] * p[2],
          r[2] * p[0] + r[5] * p[1] + r[8] * p[2]};
}

inline Vec3 transform(const Pose &pose, const Vec3 &p) { return rotate(pose, p) + pose.translation; }
inline Vec3 transform_back(const Pose &pose, const Vec3 &p) {
  return rotate_back(pose, p - pose.translation);
}

inline Pose inverse(const Pose &pose) {
  const auto &r = pose.rotation;
  Pose result;
  result.rotation = {r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]};
  result.translation = -1.0 * rotate(result, pose.translation);
  return result;
}

inline Pose compose(const Pose &a, const Pose &b) {
  Pose result;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) {
      double total = 0;
      for (int k = 0; k < 3; ++k)
        total += a.rotation[3 * row + k] * b.rotation[3 * k + column];
      result.rotation[3 * row + column] = total;
    }
  result.translation = transform(a, b.translation);
  return result;
}

// A left perturbation by the tangent [translation, rotation]. The rotation is that of the unit
// quaternion along (1, rotation / 2): equal to the exponential up to third order, without sine and
// cosine, and the result is orthonormal to machine precision.
inline Pose perturbed(const Pose &pose, const double *tangent) {
  const double a = 0.5 * tangent[3], b = 0.5 * tangent[4], c = 0.5 * tangent[5];
  const double inverse_norm = 1.0 / std::sqrt(1.0 + a * a + b * b + c * c);
  const double w = inverse_norm, x = a * inverse_norm, y = b * inverse_norm, z = c * inverse_norm;
  Pose step;
  step.rotation = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                   2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                   2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  step.translation = {tangent[0], tangent[1], tangent[2]};
  return compose(step, pose);
}

// Cholesky factor of a symmetric matrix (row-major, `size` × `size`; the lower triangle is read and
// overwritten). False where it is not positive definite.
inline bool factorise(double *matrix, int size) {
  for (int i = 0; i < size; ++i)
    for (int j = 0; j <= i; ++j) {
      double total = matrix[i * size + j];
      for (int k = 0; k < j; ++k)
        total -= matrix[i * size + k] * matrix[j * size + k];
      if (i == j) {
        if (!(total > 0))
          return false;
        matrix[i * size + i] = std::sqrt(total);
      } else {
        matrix[i * size + j] = total / matrix[j * size + j];
      }
    }
  return true;
}

// Solves L Lᵀ x = x in place.
inline void solve_factorised(const double *factor, int size, double *x) {
  for (int i = 0; i < size; ++i) {
    for (int k = 0; k < i; ++k)
      x[i] -= factor[i * size + k] * x[k];
    x[i] /= factor[i * size + i];
  }
  for (int i = size - 1; i >= 0; --i) {
    for (int k = i + 1; k < size; ++k)
      x[i] -= factor[k * size + i] * x[k];
    x[i] /= factor[i * size + i];
  }
}

// The inverse of the matrix that was factorised, row-major, full.
inline void invert_factorised(const double *factor, int size, double *result) {
  std::fill(result, result + size * size, 0.0);
  for (int column = 0; column < size; ++column) {
    // A row of the result is a column of it: the inverse is symmetric.
    result[column * size + column] = 1;
    solve_factorised(factor, size, result + column * size);
  }
}

} // namespace engram::ENGRAM_ISA
