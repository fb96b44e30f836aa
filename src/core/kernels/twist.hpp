// Tangents of rigid transforms: exp, log and adjoint, as engram.geometry.SE3 has them. Sine, cosine
// and the angle are worked out here: those of libm differ between machines.
#pragma once

#include "kernels/rigid.hpp"

namespace engram::ENGRAM_ISA {

using Tangent = std::array<double, 6>;      // [translation, rotation]
using Covariance = std::array<double, 36>;  // of a tangent, row-major

struct SineCosine {
  double sine, cosine;
};

// By Taylor's series of an eighth of the angle, doubled three times.
inline SineCosine sine_cosine(double angle) {
  const double x = angle / 8, square = x * x;
  double sine = 0, cosine = 0;
  for (int k = 9; k >= 1; --k) {
    sine = (1 + sine) * -square / (2 * k * (2 * k + 1));
    cosine = (1 + cosine) * -square / (2 * k * (2 * k - 1));
  }
  sine = x * (1 + sine);
  double versine = -cosine; // 1 − cos: keeps its digits where the angle is small
  for (int doubling = 0; doubling < 3; ++doubling) {
    const double c = 1 - versine;
    versine = 2 * sine * sine;
    sine = 2 * sine * c;
  }
  return {sine, 1 - versine};
}

// The angle in [0, π] whose sine, not negative, and cosine these are, up to their common length.
inline double angle_of(double sine, double cosine) {
  constexpr double kPi = 3.14159265358979323846;
  if (cosine < 0)
    return kPi - angle_of(sine, -cosine);
  const double length = std::sqrt(sine * sine + cosine * cosine);
  if (!(length > 0))
    return 0;
  double tangent = sine / (length + cosine); // of a half of it, at most 1
  for (int halving = 0; halving < 2; ++halving)
    tangent /= 1 + std::sqrt(1 + tangent * tangent);
  const double square = tangent * tangent; // at most 0.04
  double series = 0;
  for (int k = 12; k >= 0; --k)
    series = 1.0 / (2 * k + 1) - square * series;
  return 8 * tangent * series;
}

inline std::array<double, 9> skew(const Vec3 &v) {
  return {0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0};
}

inline std::array<double, 9> product(const std::array<double, 9> &a,
                                     const std::array<double, 9> &b) {
  std::array<double, 9> result;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column)
      result[3 * row + column] = a[3 * row] * b[column] + a[3 * row + 1] * b[3 + column] +
                                 a[3 * row + 2] * b[6 + column];
  return result;
}

// Coefficients of 1, k, k² in exp and in the left Jacobian.
inline Vec3 rodrigues_coefficients(double angle) {
  const double square = angle * angle;
  if (angle < 1e-2)
    return {1 - square / 6 * (1 - square / 20), 0.5 - square / 24 * (1 - square / 30),
            1.0 / 6 - square / 120 * (1 - square / 42)};
  const auto [sine, cosine] = sine_cosine(angle);
  return {sine / angle, (1 - cosine) / square, (angle - sine) / (square * angle)};
}

inline Pose exponential(const Tangent &tangent) {
  const Vec3 turn = {tangent[3], tangent[4], tangent[5]};
  const auto [a, b, c] = rodrigues_coefficients(norm(turn));
  const auto k = skew(turn), kk = product(k, k);
  Pose pose, jacobian;
  for (int i = 0; i < 9; ++i) {
    const double one = i % 4 == 0;
    pose.rotation[i] = one + a * k[i] + b * kk[i];
    jacobian.rotation[i] = one + b * k[i] + c * kk[i];
  }
  pose.translation = rotate(jacobian, {tangent[0], tangent[1], tangent[2]});
  return pose;
}

inline Vec3 rotation_logarithm(const std::array<double, 9> &r) {
  const Vec3 axis_sine = {0.5 * (r[7] - r[5]), 0.5 * (r[2] - r[6]), 0.5 * (r[3] - r[1])};
  const double sine = norm(axis_sine), cosine = 0.5 * (r[0] + r[4] + r[8] - 1);
  if (sine < 1e-9 && cosine > 0)
    return axis_sine;
  const double angle = angle_of(sine, cosine);
  if (angle_of(0, -1) - angle > 1e-3)
    return (angle / sine) * axis_sine;
  // Near π the antisymmetric part vanishes: the axis is taken from R + Rᵀ instead.
  int most = 0;
  for (int i = 1; i < 3; ++i)
    if (r[4 * i] > r[4 * most])
      most = i;
  Vec3 axis;
  for (int i = 0; i < 3; ++i)
    axis[i] = 0.5 * (r[3 * i + most] + r[3 * most + i]) - (i == most ? cosine : 0);
  const double sign = dot(axis, axis_sine) < 0 ? -1 : 1;
  return (sign * angle / norm(axis)) * axis;
}

inline Tangent logarithm(const Pose &pose) {
  const Vec3 turn = rotation_logarithm(pose.rotation);
  const double angle = norm(turn);
  const auto [a, b, c] = rodrigues_coefficients(angle);
  const double d = angle < 1e-2
                       ? 1.0 / 12 + angle * angle / 720 + angle * angle * angle * angle / 30240
                       : (1 - a / (2 * b)) / (angle * angle);
  const auto k = skew(turn), kk = product(k, k);
  Pose inverse_jacobian;
  for (int i = 0; i < 9; ++i)
    inverse_jacobian.rotation[i] = (i % 4 == 0) - 0.5 * k[i] + d * kk[i];
  const Vec3 moved = rotate(inverse_jacobian, pose.translation);
  return {moved[0], moved[1], moved[2], turn[0], turn[1], turn[2]};
}

// A C Aᵀ with the adjoint A of a transform: a covariance of its source frame, seen from its target.
inline Covariance carried(const Pose &pose, const Covariance &covariance) {
  const auto lever = product(skew(pose.translation), pose.rotation);
  Covariance adjoint{}, half{}, result{};
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) {
      adjoint[6 * row + column] = adjoint[6 * (3 + row) + 3 + column] =
          pose.rotation[3 * row + column];
      adjoint[6 * row + 3 + column] = lever[3 * row + column];
    }
  for (int row = 0; row < 6; ++row)
    for (int k = 0; k < 6; ++k)
      for (int column = 0; column < 6; ++column)
        half[6 * row + column] += adjoint[6 * row + k] * covariance[6 * k + column];
  for (int row = 0; row < 6; ++row)
    for (int column = 0; column < 6; ++column)
      for (int k = 0; k < 6; ++k)
        result[6 * row + column] += half[6 * row + k] * adjoint[6 * column + k];
  return result;
}

inline Covariance operator+(const Covariance &a, const Covariance &b) {
  Covariance total;
  for (int i = 0; i < 36; ++i)
    total[i] = a[i] + b[i];
  return total;
}

// One Newton step towards the nearest rotation squares the error.
inline Pose renormalised(const Pose &pose) {
  const auto &r = pose.rotation;
  const auto correction = product(product(r, inverse(pose).rotation), r);
  Pose result = pose;
  for (int i = 0; i < 9; ++i)
    result.rotation[i] = 1.5 * r[i] - 0.5 * correction[i];
  return result;
}

} // namespace engram::ENGRAM_ISA
