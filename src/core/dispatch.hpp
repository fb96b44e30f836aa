// Which of the compiled instruction sets runs. Chosen once, when the module is loaded.
#pragma once

namespace engram {

enum class Isa { generic, v3, v4 };

// The best instruction set of this machine, or the one that ENGRAM_ISA names.
// Throws std::runtime_error when ENGRAM_ISA names none, or one that this machine lacks.
Isa active_isa();
const char *name_of(Isa isa);

} // namespace engram

// ENGRAM_CALL(extract, a, b) calls engram::v4::extract(a, b) on a machine that has v4, and so on.
#ifdef ENGRAM_X86
#define ENGRAM_CALL(function, ...)                                                                 \
  (::engram::active_isa() == ::engram::Isa::v4   ? ::engram::v4::function(__VA_ARGS__)             \
   : ::engram::active_isa() == ::engram::Isa::v3 ? ::engram::v3::function(__VA_ARGS__)             \
                                                 : ::engram::generic::function(__VA_ARGS__))
#else
#define ENGRAM_CALL(function, ...) ::engram::generic::function(__VA_ARGS__)
#endif

// A kernel header declares its functions inside this, once per instruction set:
//   #define ENGRAM_KERNELS int popcount(const uint64_t *words, int count);
//   ENGRAM_DECLARE_KERNELS(...)
#define ENGRAM_DECLARE_KERNELS(...)                                                                \
  namespace engram::generic {                                                                      \
  __VA_ARGS__                                                                                      \
  }                                                                                                \
  namespace engram::v3 {                                                                           \
  __VA_ARGS__                                                                                      \
  }                                                                                                \
  namespace engram::v4 {                                                                           \
  __VA_ARGS__                                                                                      \
  }
