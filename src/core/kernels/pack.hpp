// Vectors of a fixed number of lanes, in as many registers as the instruction set needs for them.
// Whatever is computed with them is computed lane by lane, so the registers change the speed and
// never the result.
//
// The compiler's own vectors may be wider than a register, too, but are then taken apart into
// scalars: AVX2 and ARM would run at a third of their speed.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

namespace engram::ENGRAM_ISA {

#if defined(__AVX512BW__)
constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif

// The signed integer as wide as T: what comparisons of T give, 0 or −1.
template <class T>
using MaskOf = std::conditional_t<
    sizeof(T) == 8, int64_t,
    std::conditional_t<sizeof(T) == 4, int32_t,
                       std::conditional_t<sizeof(T) == 2, int16_t, int8_t>>>;

#define ENGRAM_INLINE inline __attribute__((always_inline))

// Written out, not a loop: what is indexed by a variable when functions are inlined stays in memory.
#define ENGRAM_EACH_PART(...)                                                                      \
  {                                                                                                \
    constexpr int k = 0;                                                                           \
    __VA_ARGS__;                                                                                   \
  }                                                                                                \
  if constexpr (kParts > 1) {                                                                      \
    constexpr int k = 1;                                                                           \
    __VA_ARGS__;                                                                                   \
  }                                                                                                \
  if constexpr (kParts > 2) {                                                                      \
    constexpr int k = 2;                                                                           \
    __VA_ARGS__;                                                                                   \
  }                                                                                                \
  if constexpr (kParts > 2) {                                                                      \
    constexpr int k = 3;                                                                           \
    __VA_ARGS__;                                                                                   \
  }

template <class T, int lanes> struct Pack {
  static constexpr int kBytes = lanes * static_cast<int>(sizeof(T));
  static constexpr int kPartBytes = kBytes < kRegisterBytes ? kBytes : kRegisterBytes;
  static constexpr int kParts = kBytes / kPartBytes;
  typedef T Part __attribute__((vector_size(kPartBytes)));
  typedef Pack<MaskOf<T>, lanes> Mask;
  static_assert(kParts == 1 || kParts == 2 || kParts == 4);

  Part part[kParts];

  Pack() = default;
  // The same in every lane.
  ENGRAM_INLINE Pack(T value) { // scalars stand for vectors, as in the compiler's own
    ENGRAM_EACH_PART(part[k] = Part{} + value)
  }
  static ENGRAM_INLINE Pack load(const T *from) {
    Pack pack;
    ENGRAM_EACH_PART(std::memcpy(&pack.part[k], from + k * (lanes / kParts), sizeof(Part)))
    return pack;
  }
  ENGRAM_INLINE void store(T *to) const {
    ENGRAM_EACH_PART(std::memcpy(to + k * (lanes / kParts), &part[k], sizeof(Part)))
  }

  // 0, 1, 2, …
  static ENGRAM_INLINE Pack numbers() {
    Part first{};
    for (int lane = 0; lane < lanes / kParts; ++lane)
      first[lane] = static_cast<T>(lane);
    Pack pack;
    ENGRAM_EACH_PART(pack.part[k] = first + static_cast<T>(k * (lanes / kParts)))
    return pack;
  }

  ENGRAM_INLINE T operator[](int lane) const { return reinterpret_cast<const T *>(part)[lane]; }
  ENGRAM_INLINE T &operator[](int lane) { return reinterpret_cast<T *>(part)[lane]; }

#define ENGRAM_OPERATOR(symbol)                                                                    \
  ENGRAM_INLINE Pack &operator symbol##=(const Pack &other) {                                      \
    ENGRAM_EACH_PART(part[k] symbol## = other.part[k])                                             \
    return *this;                                                                                  \
  }                                                                                                \
  friend ENGRAM_INLINE Pack operator symbol(const Pack &a, const Pack &b) {                        \
    Pack result;                                                                                   \
    ENGRAM_EACH_PART(result.part[k] = a.part[k] symbol b.part[k])                                  \
    return result;                                                                                 \
  }
  ENGRAM_OPERATOR(+)
  ENGRAM_OPERATOR(-)
  ENGRAM_OPERATOR(*)
  ENGRAM_OPERATOR(/)
  ENGRAM_OPERATOR(&)
  ENGRAM_OPERATOR(|)
  ENGRAM_OPERATOR(^)
#undef ENGRAM_OPERATOR

  ENGRAM_INLINE Pack operator-() const {
    Pack result;
    ENGRAM_EACH_PART(result.part[k] = -part[k])
    return result;
  }
  ENGRAM_INLINE Pack operator~() const {
    Pack result;
    ENGRAM_EACH_PART(result.part[k] = ~part[k])
    return result;
  }
  ENGRAM_INLINE Pack operator<<(int bits) const {
    Pack result;
    ENGRAM_EACH_PART(result.part[k] = part[k] << bits)
    return result;
  }
  ENGRAM_INLINE Pack operator>>(int bits) const {
    Pack result;
    ENGRAM_EACH_PART(result.part[k] = part[k] >> bits)
    return result;
  }

#define ENGRAM_COMPARISON(symbol)                                                                  \
  friend ENGRAM_INLINE Mask operator symbol(const Pack &a, const Pack &b) {                        \
    Mask result;                                                                                   \
    ENGRAM_EACH_PART(result.part[k] = (typename Mask::Part)(a.part[k] symbol b.part[k]))           \
    return result;                                                                                 \
  }
  ENGRAM_COMPARISON(<)
  ENGRAM_COMPARISON(<=)
  ENGRAM_COMPARISON(>)
  ENGRAM_COMPARISON(>=)
  ENGRAM_COMPARISON(==)
#undef ENGRAM_COMPARISON

  // a where the mask holds, else b.
  static ENGRAM_INLINE Pack select(const Mask &mask, const Pack &a, const Pack &b) {
    Pack result;
    if constexpr (sizeof(T) == 8 && kRegisterBytes == 16) { // SSE2 selects no 64-bit lanes
      typedef typename Mask::Part Bits;
      ENGRAM_EACH_PART(result.part[k] = (Part)(((Bits)a.part[k] & mask.part[k]) |
                                               ((Bits)b.part[k] & ~mask.part[k])))
    } else {
      ENGRAM_EACH_PART(result.part[k] = mask.part[k] ? a.part[k] : b.part[k])
    }
    return result;
  }

  // The same bits as lanes of another kind.
  template <class To> ENGRAM_INLINE To as() const {
    static_assert(To::kParts == kParts);
    To to;
    ENGRAM_EACH_PART(to.part[k] = (typename To::Part)part[k])
    return to;
  }
};

template <class T, int lanes>
ENGRAM_INLINE Pack<T, lanes> select(const Pack<MaskOf<T>, lanes> &mask, const Pack<T, lanes> &a,
                                    const std::type_identity_t<Pack<T, lanes>> &b) {
  return Pack<T, lanes>::select(mask, a, b);
}

template <class T, int lanes>
ENGRAM_INLINE Pack<T, lanes> smaller(const Pack<T, lanes> &a, const Pack<T, lanes> &b) {
  return select(a < b, a, b);
}

template <class T, int lanes>
ENGRAM_INLINE Pack<T, lanes> larger(const Pack<T, lanes> &a, const Pack<T, lanes> &b) {
  return select(a > b, a, b);
}

// Sixteen bytes of a pack of 64.
template <int quarter, class T, int lanes> ENGRAM_INLINE auto quarter_of(const Pack<T, lanes> &of) {
  constexpr int per = 16 / sizeof(T), parts = Pack<T, lanes>::kParts;
  constexpr int first = quarter % (4 / parts) * per;
  const auto &part = of.part[quarter * parts / 4];
  if constexpr (parts == 4)
    return part;
  else if constexpr (per == 4)
    return __builtin_shufflevector(part, part, first, first + 1, first + 2, first + 3);
  else
    return __builtin_shufflevector(part, part, first, first + 1, first + 2, first + 3, first + 4,
                                   first + 5, first + 6, first + 7);
}

} // namespace engram::ENGRAM_ISA
