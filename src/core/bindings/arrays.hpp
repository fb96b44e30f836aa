// The array types that cross the border between Python and C++.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <utility>
#include <vector>

namespace engram {

template <class T, int dimensions>
using Input = nanobind::ndarray<const T, nanobind::ndim<dimensions>, nanobind::c_contig,
                                nanobind::device::cpu>;

// Binary descriptors: (N, 32) uint8 in Python, four 64-bit words per row here.
using Descriptors =
    nanobind::ndarray<const uint8_t, nanobind::shape<-1, 32>, nanobind::c_contig,
                      nanobind::device::cpu>;

inline const uint64_t *words(const Descriptors &descriptors) {
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
