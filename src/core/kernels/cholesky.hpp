// Cholesky factorisation of a dense system of some tens of unknowns. Every loop that is innermost
// runs along a row and has no carried sum: it vectorises without changing a bit.
#pragma once

#include <algorithm>
#include <cmath>

namespace engram::ENGRAM_ISA {

// A = UᵀU of a symmetric matrix (row-major, `size` × `size`); the upper triangle is read and
// overwritten by U. False where A is not positive definite.
inline bool factorise_upper(double *matrix, int size) {
  for (int k = 0; k < size; ++k) {
    double *row = matrix + k * size;
    if (!(row[k] > 0))
      return false;
    row[k] = std::sqrt(row[k]);
    for (int j = k + 1; j < size; ++j)
      row[j] /= row[k];
    for (int i = k + 1; i < size; ++i) {
      double *below = matrix + i * size;
      const double factor = row[i];
      for (int j = i; j < size; ++j)
        below[j] -= factor * row[j];
    }
  }
  return true;
}

// Solves UᵀU X = X in place, X row-major with `columns` right-hand sides.
inline void solve_upper(const double *factor, int size, double *x, int columns) {
  const auto subtract = [&](int i, int k, double scale) {
    double *to = x + i * columns;
    const double *from = x + k * columns;
    for (int c = 0; c < columns; ++c)
      to[c] -= scale * from[c];
  };
  const auto divide = [&](int i) {
    const double pivot = factor[i * size + i];
    for (int c = 0; c < columns; ++c)
      x[i * columns + c] /= pivot;
  };
  for (int i = 0; i < size; ++i) {
    for (int k = 0; k < i; ++k)
      subtract(i, k, factor[k * size + i]);
    divide(i);
  }
  for (int i = size - 1; i >= 0; --i) {
    for (int k = i + 1; k < size; ++k)
      subtract(i, k, factor[i * size + k]);
    divide(i);
  }
}

// The inverse of the matrix that was factorised, row-major, full.
inline void invert_upper(const double *factor, int size, double *result) {
  std::fill(result, result + size * size, 0.0);
  for (int i = 0; i < size; ++i)
    result[i * size + i] = 1;
  solve_upper(factor, size, result, size);
}

} // namespace engram::ENGRAM_ISA
