#include "kernels/transforms.hpp"

#include <cmath>

namespace engram::ENGRAM_ISA {
namespace {

// Below this angle the closed forms lose digits to cancellation; the series up to the fourth power
// are exact to 1e-15 there.
constexpr double kSmallAngle_rad = 1e-2;

double fused(double a, double b, double c) { return __builtin_fma(a, b, c); }

// c = a b, of (rows × inner) and (inner × columns).
template <int rows, int inner, int columns>
void multiply(const double *a, const double *b, double *c) {
  for (int row = 0; row < rows; ++row)
    for (int column = 0; column < columns; ++column) {
      double total = a[inner * row] * b[column];
      for (int k = 1; k < inner; ++k)
        total = fused(a[inner * row + k], b[columns * k + column], total);
      c[columns * row + column] = total;
    }
}

// c = a bᵀ, of square matrices.
template <int size> void multiply_transposed(const double *a, const double *b, double *c) {
  double transposed[size * size];
  for (int row = 0; row < size; ++row)
    for (int column = 0; column < size; ++column)
      transposed[size * column + row] = b[size * row + column];
  multiply<size, size, size>(a, transposed, c);
}

// The product of a 3×3 matrix and a vector, summed as a matrix–vector product of BLAS is.
void rotate(const double *matrix, const double *vector, double *result) {
  for (int row = 0; row < 3; ++row, matrix += 3)
    result[row] = fused(matrix[2], vector[2],
                        fused(matrix[0], vector[0], matrix[1] * vector[1]));
}

double dot(const double *a, const double *b) {
  return fused(a[2], b[2], fused(a[1], b[1], a[0] * b[0]));
}

double length(const double *v) { return std::sqrt(dot(v, v)); }

void skew(const double *v, double *matrix) {
  const double values[9] = {0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0};
  for (int k = 0; k < 9; ++k)
    matrix[k] = values[k];
}

// Factors of 1, K, K² in the exponential and in the left Jacobian.
struct Rodrigues {
  double a, b, c;

  explicit Rodrigues(double angle) {
    const double square = angle * angle;
    if (angle < kSmallAngle_rad) {
      a = 1 - square / 6 * (1 - square / 20);
      b = 0.5 - square / 24 * (1 - square / 30);
      c = 1.0 / 6 - square / 120 * (1 - square / 42);
    } else {
      const double sine = std::sin(angle), cosine = std::cos(angle);
      a = sine / angle;
      b = (1 - cosine) / square;
      c = (angle - sine) / (square * angle);
    }
  }
};

// I + p K + q K².
void combination(double p, const double *k, double q, const double *kk, double *result) {
  for (int i = 0; i < 9; ++i)
    result[i] = ((i % 4 == 0 ? 1.0 : 0.0) + p * k[i]) + q * kk[i];
}

// Carries tangent vectors from the source to the target frame.
void adjoint_of(const double *transform, double *adjoint) {
  double k[9], lever[9];
  skew(transform + 9, k);
  multiply<3, 3, 3>(k, transform, lever);
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) {
      const double turn = transform[3 * row + column];
      adjoint[6 * row + column] = adjoint[6 * (row + 3) + column + 3] = turn;
      adjoint[6 * row + column + 3] = lever[3 * row + column];
      adjoint[6 * (row + 3) + column] = 0;
    }
}

// The antisymmetric part of a rotation: its axis times the sine of its angle.
void sines_of(const double *r, double *sines) {
  sines[0] = 0.5 * (r[7] - r[5]), sines[1] = 0.5 * (r[2] - r[6]), sines[2] = 0.5 * (r[3] - r[1]);
}

// The axis of a turn of nearly half a circle, times its angle: the antisymmetric part `sines` has
// vanished, so it comes from r + rᵀ.
void half_turn_of(const double *r, const double *sines, double cosine, double angle,
                  double *turn) {
  double symmetric[9];
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column)
      symmetric[3 * row + column] = (r[3 * row + column] + r[3 * column + row]) / 2 -
                                    (row == column ? cosine : 0.0);
  int longest = 0;
  for (int k = 1; k < 3; ++k)
    if (symmetric[4 * k] > symmetric[4 * longest])
      longest = k;
  const double *axis = symmetric + 3 * longest;
  const double size = length(axis);
  const double sign = dot(axis, sines) < 0 ? -1 : 1;
  for (int k = 0; k < 3; ++k)
    turn[k] = angle * (sign * (axis[k] / size));
}

// The rotation vector of a rotation by this angle.
void rotation_vector(const double *r, double angle, double *turn) {
  double sines[3], sine, cosine;
  sines_of(r, sines);
  turn_of(r, &sine, &cosine);
  const bool none = sine < 1e-9 && cosine > 0;
  if (!none && !(M_PI - angle > 1e-3))
    return half_turn_of(r, sines, cosine, angle, turn);
  for (int k = 0; k < 3; ++k)
    turn[k] = none ? sines[k] : sines[k] * (angle / sine);
}

} // namespace

void chain(const double *a_from_b, const double *covariance_ab, const double *b_from_c,
           const double *covariance_bc, double *a_from_c, double *covariance_ac) {
  multiply<3, 3, 3>(a_from_b, b_from_c, a_from_c);
  rotate(a_from_b, b_from_c + 9, a_from_c + 9);
  for (int k = 9; k < 12; ++k)
    a_from_c[k] += a_from_b[k];
  double adjoint[36], half[36];
  adjoint_of(a_from_b, adjoint);
  multiply<6, 6, 6>(adjoint, covariance_bc, half);
  multiply_transposed<6>(half, adjoint, covariance_ac);
  for (int k = 0; k < 36; ++k)
    covariance_ac[k] = covariance_ab[k] + covariance_ac[k];
}

void transform_of(const double *tangent, double *transform) {
  const Rodrigues factor(length(tangent + 3));
  double k[9], kk[9], jacobian[9];
  skew(tangent + 3, k);
  multiply<3, 3, 3>(k, k, kk);
  combination(factor.a, k, factor.b, kk, transform);
  combination(factor.b, k, factor.c, kk, jacobian);
  rotate(jacobian, tangent, transform + 9);
}

void turn_of(const double *r, double *sine, double *cosine) {
  double sines[3];
  sines_of(r, sines);
  *sine = length(sines);
  *cosine = 0.5 * ((r[0] + r[4] + r[8]) - 1);
}

void tangent_of(const double *transform, double turned_by, double *tangent) {
  double *turn = tangent + 3;
  rotation_vector(transform, turned_by, turn);
  const double angle = length(turn);
  double d; // factor of K² in the inverse of the left Jacobian
  if (angle < kSmallAngle_rad) {
    const double square = angle * angle;
    d = 1.0 / 12 + square / 720 + square * square / 30240;
  } else {
    const Rodrigues factor(angle);
    d = (1 - factor.a / (2 * factor.b)) / (angle * angle);
  }
  double k[9], kk[9], inverse_jacobian[9];
  skew(turn, k);
  multiply<3, 3, 3>(k, k, kk);
  combination(-0.5, k, d, kk, inverse_jacobian);
  rotate(inverse_jacobian, transform + 9, tangent);
}

void orthonormalise(const double *matrix, double *rotation) {
  double half[9], square[9], cube[9];
  for (int k = 0; k < 9; ++k)
    half[k] = 0.5 * matrix[k];
  multiply_transposed<3>(half, matrix, square);
  multiply<3, 3, 3>(square, matrix, cube);
  for (int k = 0; k < 9; ++k)
    rotation[k] = 1.5 * matrix[k] - cube[k];
}

} // namespace engram::ENGRAM_ISA
