// Scratch memory that grows and is used again: fresh pages for every frame would cost more than
// the kernels that fill them. Not std::vector: its functions, compiled here for one instruction
// set, could be linked into code that runs on another.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>

namespace engram::ENGRAM_ISA {

template <class T> class Buffer {
public:
  Buffer() = default;
  Buffer(const Buffer &) = delete;
  Buffer &operator=(const Buffer &) = delete;
  ~Buffer() { std::free(start_); }

  // Room for `count` elements, uninitialised.
  T *room_for(size_t count) {
    if (count > capacity_) {
      std::free(start_);
      capacity_ = 0;
      start_ = static_cast<T *>(std::malloc(count * sizeof(T)));
      if (start_ == nullptr)
        throw std::bad_alloc();
      capacity_ = count;
    }
    return start_;
  }

private:
  T *start_ = nullptr;
  size_t capacity_ = 0;
};

} // namespace engram::ENGRAM_ISA
