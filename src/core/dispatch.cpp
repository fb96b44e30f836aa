#include "dispatch.hpp"

#include <cstdlib>
#include <stdexcept>
#include <string>

namespace engram {
namespace {

Isa best_isa() {
#ifdef ENGRAM_X86
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vpopcntdq") && __builtin_cpu_supports("avx512vnni"))
    return Isa::v4;
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("bmi2") &&
      __builtin_cpu_supports("fma") && __builtin_cpu_supports("popcnt"))
    return Isa::v3;
#endif
  return Isa::generic;
}

Isa chosen_isa() {
  const Isa best = best_isa();
  const char *asked = std::getenv("ENGRAM_ISA");
  if (asked == nullptr || *asked == '\0')
    return best;
  for (const Isa isa : {Isa::generic, Isa::v3, Isa::v4}) {
    if (std::string(asked) != name_of(isa))
      continue;
    if (isa > best)
      throw std::runtime_error(std::string("ENGRAM_ISA=") + asked +
                               ": this machine has no more than " + name_of(best));
    return isa;
  }
  throw std::runtime_error(std::string("ENGRAM_ISA=") + asked +
                           ": expected one of generic, v3, v4");
}

} // namespace

Isa active_isa() {
  static const Isa isa = chosen_isa();
  return isa;
}

const char *name_of(Isa isa) {
  return isa == Isa::v4 ? "v4" : isa == Isa::v3 ? "v3" : "generic";
}

} // namespace engram
