#include "kernels/hamming.hpp"

#include "bindings/arrays.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

auto hamming_matrix(const engram::Descriptors &a, const engram::Descriptors &b) {
  const size_t a_count = a.shape(0), b_count = b.shape(0);
  const int width = engram::common_width(a, b);
  std::vector<uint16_t> distances(a_count * b_count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(hamming_matrix, engram::words(a), static_cast<int64_t>(a_count), engram::words(b),
                static_cast<int64_t>(b_count), width, distances.data());
  }
  return engram::to_numpy(std::move(distances), {a_count, b_count});
}

} // namespace

void bind_hamming(nb::module_ &module) {
  module.def("hamming_matrix", &hamming_matrix, "a"_a, "b"_a,
             "Hamming distances (N, M) uint16 between descriptors (N, B) and (M, B) uint8.");
}
