#include "kernels/kept.hpp"

#include "bindings/features.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

auto kept_rows(const engram::Features &before, const engram::Features &now, int most_bits,
               float most_disparity_px) {
  engram::common_width(before.descriptors, now.descriptors);
  for (const auto &pixels : {before.pixels, now.pixels})
    for (size_t i = 0; i < 2 * pixels.shape(0); ++i)
      if (!(pixels.data()[i] >= 0 && pixels.data()[i] <= 65535))
        throw nb::value_error("pixels must lie in 0 to 65535");
  std::vector<int32_t> rows(before.pixels.shape(0));
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(kept_rows, before.view(), now.view(), most_bits, most_disparity_px, rows.data());
  }
  const size_t count = rows.size();
  return engram::to_numpy(std::move(rows), {count});
}

} // namespace

void bind_kept(nb::module_ &module) {
  module.def("kept_rows", &kept_rows, "before"_a, "now"_a, "most_bits"_a, "most_disparity_px"_a,
             "Rows (N,) int32 of `now` at the pixels of the N landmarks of `before`, within one "
             "pixel, of nearly the same descriptor and disparity; -1 where there is none.");
}
