#include "kernels/ordering.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace engram::ENGRAM_ISA {
namespace {

// Orders as the number does, in integers: NaN has its place, and −0 is 0.
uint64_t sortable(double value) {
  value += 0.0;
  uint64_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  const uint64_t sign = uint64_t{1} << 63;
  return bits & sign && !std::isnan(value) ? ~bits : bits | sign;
}

double interpolate(const double *values, int64_t bins, double at) {
  if (std::isnan(at))
    return at;
  if (at <= 0)
    return values[0];
  if (at >= static_cast<double>(bins - 1))
    return values[bins - 1];
  const auto below = static_cast<int64_t>(at);
  return values[below] + (at - static_cast<double>(below)) * (values[below + 1] - values[below]);
}

} // namespace

void order_rows(const std::vector<const double *> &keys, int64_t count, const uint64_t *uuid_words,
                int64_t *order) {
  struct Row {
    uint64_t first;
    int64_t number;
  };
  std::vector<Row> rows(static_cast<size_t>(count));
  for (int64_t i = 0; i < count; ++i)
    rows[static_cast<size_t>(i)] = {keys.empty() ? 0 : sortable(keys[0][i]), i};
  std::sort(rows.begin(), rows.end(), [&](const Row &a, const Row &b) {
    if (a.first != b.first)
      return a.first < b.first;
    for (size_t k = 1; k < keys.size(); ++k)
      if (const uint64_t x = sortable(keys[k][a.number]), y = sortable(keys[k][b.number]); x != y)
        return x < y;
    const uint64_t *x = uuid_words + 2 * a.number;
    const uint64_t *y = uuid_words + 2 * b.number;
    return x[0] != y[0] ? x[0] < y[0] : x[1] != y[1] ? x[1] < y[1] : a.number < b.number;
  });
  for (int64_t i = 0; i < count; ++i)
    order[i] = rows[static_cast<size_t>(i)].number;
}

void success_rates(const double *rates, int64_t bins, double bin_m, const double *along_m,
                   const double *across_m, int64_t count, double *result) {
  const double at_zero = std::max(std::max(rates[0], rates[bins]), 1e-9);
  for (int64_t i = 0; i < count; ++i) {
    const double along = interpolate(rates, bins, std::abs(along_m[i]) / bin_m - 0.5);
    const double across = interpolate(rates + bins, bins, std::abs(across_m[i]) / bin_m - 0.5);
    result[i] = std::min(along * across / at_zero, 1.0);
  }
}

} // namespace engram::ENGRAM_ISA
