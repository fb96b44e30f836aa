// Textures sampled for one pixel a lane: mip-mapped, and along the long axis of its footprint.
#pragma once

#include "kernels/pixel_lanes.hpp"
#include "kernels/scene.hpp"

namespace engram::ENGRAM_ISA::wide {

// Sixteen surfaces' records turned into lanes.
struct SurfaceLanes {
  Vec normal;
  Floats offset;
  Vec along_u;
  Floats u_at_origin;
  Vec along_v;
  Floats v_at_origin;
  Floats tint, glow;
  Ints texture, flags;
};

inline SurfaceLanes gathered(const Surface *const *surfaces) {
  static_assert(sizeof(Surface) == 16 * sizeof(float));
  Floats f[16];
  for (int block = 0; block < 16 / kWide; ++block) {
    for (int lane = 0; lane < kWide; ++lane)
      f[block * kWide + lane] =
          load(reinterpret_cast<const float *>(surfaces[lane]) + block * kWide);
    transpose(f + block * kWide);
  }
  return {{f[0], f[1], f[2]},  f[3],  {f[4], f[5], f[6]}, f[7], {f[8], f[9], f[10]}, f[11], f[12],
          f[13], as_ints(f[14]), as_ints(f[15])};
}

struct Texels {
  Floats albedo, slope_u, slope_v, special;
};

// A mip level of each lane's texture.
struct Level {
  Addresses texels;
  Ints stride;
  Floats width, height;
};

inline Level level_of(const Mips &mips, Ints entry) {
  const Ints size = gather(mips.sizes, entry), width = size & 0xffff;
  return {gather(mips.texels, entry), width + 2, to_floats(width), to_floats(size >> 16)};
}

// Adds the four texels around a place, each times its weight. Channels are left where they stand
// in their word, and scaled once at the end.
inline void add_tap(Texels &sum, const Level &level, Floats u, Floats v, Floats weight) {
  const Floats x = (u - floor_of(u)) * level.width - 0.5f;
  const Floats y = (v - floor_of(v)) * level.height - 0.5f;
  const Floats x_floor = floor_of(x), y_floor = floor_of(y);
  const Ints offset = (truncated(y_floor) * level.stride + truncated(x_floor)) * 4;
  const Addresses at = level.texels + widened(offset);
  const Pairs top = load_pairs(at), bottom = load_pairs(at + widened(level.stride * 4));
  const Floats a = x - x_floor, b = y - y_floor;
  const Floats upper = weight * (1 - b), lower = weight * b;
  const Ints words[4] = {top.left, top.right, bottom.left, bottom.right};
  const Floats weights[4] = {upper * (1 - a), upper * a, lower * (1 - a), lower * a};
  for (int k = 0; k < 4; ++k) {
    sum.albedo += to_floats(words[k] & 0xff) * weights[k];
    sum.slope_u += to_floats(words[k] & 0xff00) * weights[k];
    sum.slope_v += to_floats(words[k] & 0xff0000) * weights[k];
    sum.special += to_floats((words[k] >> 24) & 0xff) * weights[k];
  }
}

constexpr float kMaxTaps = 5;

// Anisotropic: taps along the long axis of the pixel's footprint, each of the size of the short
// one. `along` is that axis on the surface.
inline Texels sample(const Mips &mips, const SurfaceLanes &surface, Floats u, Floats v,
                     const Vec &along, Floats minor_m, Floats stretch) {
  Floats taps = floor_of(stretch + 0.5f);
  taps = smaller(larger(taps, all(1.0f)), all(kMaxTaps));
  const Floats step_m = minor_m * stretch / taps;
  const Ints first = surface.texture * kMipLevels;
  const Ints size0 = gather(mips.sizes, first);
  const Floats width = to_floats(size0 & 0xffff), height = to_floats(size0 >> 16);
  const Floats u_texels2 = dot(surface.along_u, surface.along_u) * width * width,
               v_texels2 = dot(surface.along_v, surface.along_v) * height * height;
  const Floats per_m = root(larger(u_texels2, v_texels2));
  // A quarter more than a pixel: sharper, the grid of texels beats with that of pixels.
  const Floats size = 1.25f * larger(step_m, minor_m) * per_m;
  const Ints top = gather(mips.counts, surface.texture) - 1;
  const Floats level = smaller(log2_of(larger(size, all(1.0f))), to_floats(top));
  const Ints fine = truncated(level);
  const Ints has_coarse = fine < top;
  // One level alone near each whole number, a blend of two half way between.
  const Floats blend = where(has_coarse, clamp01(2 * (level - to_floats(fine)) - 0.5f));
  const Floats du = dot(surface.along_u, along) * step_m, dv = dot(surface.along_v, along) * step_m;
  const Floats share = 1 / taps, fine_share = share * (1 - blend), coarse_share = share * blend;
  const bool any_fine = any(fine_share > 0), any_coarse = any(coarse_share > 0);
  const Level fine_level = level_of(mips, first + fine);
  const Level coarse_level = any_coarse ? level_of(mips, first + fine - has_coarse) : fine_level;
  Texels sum = {};
  for (float k = 0; k < kMaxTaps; ++k) {
    const Ints in_use = taps > k;
    if (!any(in_use))
      break;
    const Floats s = where(in_use, k - 0.5f * (taps - 1));
    const Floats tap_u = u + du * s, tap_v = v + dv * s;
    if (any_fine)
      add_tap(sum, fine_level, tap_u, tap_v, where(in_use, fine_share));
    if (any_coarse)
      add_tap(sum, coarse_level, tap_u, tap_v, where(in_use, coarse_share));
  }
  return {sum.albedo * (1 / 255.0f), (sum.slope_u * (1.0f / (1 << 8)) - 128) * (1 / 100.0f),
          (sum.slope_v * (1.0f / (1 << 16)) - 128) * (1 / 100.0f), sum.special * (1 / 255.0f)};
}

} // namespace engram::ENGRAM_ISA::wide
