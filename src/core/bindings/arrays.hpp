// The array types that cross the border between Python and C++.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <utility>
#include <vector>

#include "kernels/types.hpp"

namespace engram {

template <class T, int dimensions>
using Input = nanobind::ndarray<const T, nanobind::ndim<dimensions>, nanobind::c_contig,
                                nanobind::device::cpu>;

// Binary descriptors: (N, B) uint8 in Python, B / 8 64-bit words per row here.
using Descriptors = Input<uint8_t, 2>;

// 64-bit words of a descriptor.
inline int width_of(const Descriptors &descriptors) {
  const size_t bytes = descriptors.shape(1);
  if (bytes == 0 || bytes % 8 != 0 || bytes / 8 > kMostWords)
    throw nanobind::value_error("descriptors must have 8, 16, 24 … up to 2048 bytes");
  return static_cast<int>(bytes / 8);
}

// The width that both have.
inline int common_width(const Descriptors &a, const Descriptors &b) {
  if (a.shape(1) != b.shape(1))
    throw nanobind::value_error("descriptors of different widths cannot be compared");
  return width_of(a);
}

// NumPy lets bytes start anywhere; words must not: their loads may be aligned ones.
inline const uint64_t *words(const Descriptors &descriptors) {
  if (reinterpret_cast<uintptr_t>(descriptors.data()) % alignof(uint64_t) != 0)
    throw nanobind::value_error("descriptors must start at a multiple of 8 bytes: pass a copy");
  return reinterpret_cast<const uint64_t *>(descriptors.data());
}

// Hands a vector over to NumPy without a copy.
template <class T>
nanobind::ndarray<nanobind::numpy, T> to_numpy(std::vector<T> &&values,
                                               std::initializer_list<size_t> shape) {
  auto *owned = new std::vector<T>(std::move(values));
  nanobind::capsule owner(owned,
                          [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
  return nanobind::ndarray<nanobind::numpy, T>(owned->data(), shape, owner);
}

} // namespace engram
