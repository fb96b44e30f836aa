#include "kernels/ordering.hpp"

#include "bindings/arrays.hpp"

#include <stdexcept>

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Input;

auto order_rows(const Input<uint64_t, 2> &uuid_words, const nb::args &arguments) {
  const size_t count = uuid_words.shape(0);
  if (uuid_words.shape(1) != 2)
    throw nb::value_error("order_rows: uuid_words must have shape (Y, 2)");
  std::vector<Input<double, 1>> held;
  std::vector<const double *> keys;
  for (const nb::handle &argument : arguments) {
    held.push_back(nb::cast<Input<double, 1>>(argument));
    if (held.back().shape(0) != count)
      throw nb::value_error("order_rows: a key must have one value per row");
    keys.push_back(held.back().data());
  }
  std::vector<int64_t> order(count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(order_rows, keys, static_cast<int64_t>(count), uuid_words.data(), order.data());
  }
  return engram::to_numpy(std::move(order), {count});
}

auto success_rates(const Input<double, 2> &rates, double bin_m, const Input<double, 1> &along_m,
                   const Input<double, 1> &across_m) {
  const size_t count = along_m.shape(0);
  if (rates.shape(0) != 2 || rates.shape(1) == 0 || !(bin_m > 0))
    throw nb::value_error("success_rates: rates must have shape (2, B), bins a positive width");
  if (across_m.shape(0) != count)
    throw nb::value_error("success_rates: as many offsets across as along are needed");
  std::vector<double> result(count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(success_rates, rates.data(), static_cast<int64_t>(rates.shape(1)), bin_m,
                along_m.data(), across_m.data(), static_cast<int64_t>(count), result.data());
  }
  return engram::to_numpy(std::move(result), {count});
}

} // namespace

void bind_ordering(nb::module_ &module) {
  module.def("order_rows", &order_rows, "uuid_words"_a, "keys"_a,
             "Rows (Y,) int64 by key after key (Y,) float64, smallest first, then by UUID (Y, 2).");
  module.def("success_rates", &success_rates, "rates"_a, "bin_m"_a, "along_m"_a, "across_m"_a,
             "g(along) g(across) / g(0), (N,) float64, of rates (2, B) in the middle of the bins.");
}
