// The width of binary descriptors: any number of 64-bit words, four being the usual one.
#pragma once

#include <type_traits>

#include "kernels/types.hpp"

namespace engram::ENGRAM_ISA {

// Calls work(width) with a constant where descriptors have four words, so that loops over them
// unroll, else with the number itself.
template <class Work> inline auto with_width(int width, Work work) {
  return width == 4 ? work(std::integral_constant<int, 4>{}) : work(width);
}

// Room for a descriptor of a width that may only be known when it runs.
constexpr int most_words(int) { return kMostWords; }
constexpr int most_words(std::integral_constant<int, 4>) { return 4; }

} // namespace engram::ENGRAM_ISA
