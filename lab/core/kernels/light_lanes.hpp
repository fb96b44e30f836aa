// What lights a point, one pixel a lane: sky, sun, lamps, headlights, and what weather makes of it.
#pragma once

#include "kernels/texture_lanes.hpp"

namespace engram::ENGRAM_ISA::wide {

// A map of the sun, its coordinates counted from the eye, where floats are fine enough.
struct SunMap {
  float right[3], below[3], up[3];
  float column, row, height; // of the eye
  float texel_m2;
  const float *heights; // null when there is none
  int32_t width, rows;
};

// All that stays the same for a picture.
struct Frame {
  const Surroundings &world;
  const Light &light;
  float eye[3], rotation[9];
  float fx, fy, cx, cy;
  SunMap sun_static, sun_moving;
};

// What a pixel's surface is and how it is seen.
struct Point {
  Vec at, from_eye, to_eye, flat_normal, normal;
  Floats cosine; // between flat normal and to_eye
  Floats distance_m;
  Ints flags;
  Floats wet;    // how much of a water film lies here
  Floats across; // where on a carriageway, 0…1 between its kerbs

  Ints has(uint32_t flag) const { return (flags & static_cast<int32_t>(flag)) != 0; }
};

// Smooth noise in 0…1 that tiles; one unit is one of its 256 texels.
inline Floats noise_at(const int32_t *noise_quads, Floats x, Floats y) {
  const Floats x_floor = floor_of(x), y_floor = floor_of(y);
  const Ints i = truncated(x_floor) & 255, j = truncated(y_floor) & 255;
  const Ints quad = gather(noise_quads, j * 256 + i);
  const Floats a = x - x_floor, b = y - y_floor;
  const Floats top = mix(to_floats(quad & 255), to_floats((quad >> 8) & 255), a);
  const Floats bottom = mix(to_floats((quad >> 16) & 255), to_floats((quad >> 24) & 255), a);
  return mix(top, bottom, b) * (1 / 255.0f);
}

inline Floats clouded(const Frame &frame, const Vec &d, Floats up, Floats blue) {
  const Light &light = frame.light;
  const int32_t *noise = frame.world.noise_quads;
  const Floats x = d.x / (up + 0.12f) * 22 + light.cloud_shift[0];
  const Floats y = d.y / (up + 0.12f) * 22 + light.cloud_shift[1];
  const Floats field = 0.62f * noise_at(noise, x, y) +
                       0.28f * noise_at(noise, 2.3f * x + 37, 2.3f * y + 11) +
                       0.1f * noise_at(noise, 6.1f * x + 5, 6.1f * y + 91);
  const float edge = 0.97f - 1.05f * light.cloud;
  const Floats cover = smooth(edge - 0.09f, edge + 0.09f, field);
  const Floats lit =
      (0.62f + 0.45f * (1 - field) + 0.2f * up) * (light.sky_power + 0.09f * light.sun_power);
  return mix(blue, 1.15f * lit, cover);
}

// Luminance of the sky towards a unit direction; a dark rim of far trees and hills below.
inline Floats sky(const Frame &frame, const Vec &d) {
  const Light &light = frame.light;
  const Floats level = root(d.x * d.x + d.y * d.y) + 1e-6f;
  const Floats rim = 0.012f + 0.07f * noise_at(frame.world.noise_quads, 128 + 90 * d.x / level,
                                               128 + 90 * d.y / level);
  const Ints below = d.z < rim * level;
  const Floats up = larger(d.z, all(0.02f));
  const Floats around = larger(dot(d, everywhere(light.sun)), Floats{});
  const Floats glow = power8(around), disc = power8(glow * glow);
  Floats above =
      light.sky_power * (1.15f - 0.5f * root(up)) + light.sun_power * (0.12f * glow + 0.9f * disc);
  if (light.cloud > 0.01f && any(~below))
    above = clouded(frame, d, up, above);
  return below ? all(0.28f * light.sky_power + 0.02f * light.sun_power) : above;
}

typedef float f32x4 __attribute__((vector_size(16)));
typedef int32_t i32x4 __attribute__((vector_size(16)));

// One pixel's share of the 3×3 tent that is shaded, in ninths: each texel is compared with the
// height that the receiving plane itself has there.
inline float shaded_ninths(const float *heights, int64_t stride, float a, float b, float height,
                           float slope_x, float slope_y) {
  const f32x4 across = {1 - a, 1, 1, a};
  const float down[4] = {1 - b, 1, 1, b};
  const f32x4 plane = f32x4{-1 - a, -a, 1 - a, 2 - a} * slope_x;
  f32x4 shaded = {0, 0, 0, 0};
  for (int row = 0; row < 4; ++row) {
    f32x4 texels;
    std::memcpy(&texels, heights + row * stride, 16);
    const f32x4 weights = across * down[row];
    const f32x4 receiver = plane + (height + slope_y * (static_cast<float>(row - 1) - b));
    shaded += reinterpret_cast<f32x4>(reinterpret_cast<i32x4>(weights) & (texels > receiver));
  }
  return (shaded[0] + shaded[1]) + (shaded[2] + shaded[3]);
}

// Share of the sun that reaches points, where wanted: a 3×3 tent over the map's texels, which is
// about as wide as the sun's own penumbra ten metres behind an edge. A plane never shades itself,
// whatever its tilt, and shadows stay attached with a small bias.
inline Floats sunlit(const SunMap &map, const Vec &from_eye, const Vec &normal, Ints wanted) {
  const Vec right = everywhere(map.right), below = everywhere(map.below), up = everywhere(map.up);
  const Floats x = dot(right, from_eye) + map.column, y = dot(below, from_eye) + map.row;
  const Floats height = dot(up, from_eye) + map.height;
  const Floats scale = -map.texel_m2 / larger(dot(normal, up), all(0.05f));
  const Floats slope_x = scale * dot(normal, right), slope_y = scale * dot(normal, below);
  const Floats x_floor = floor_of(x), y_floor = floor_of(y);
  const Ints inside = wanted & (x_floor >= 1) & (y_floor >= 1) &
                      (x_floor < static_cast<float>(map.width - 2)) &
                      (y_floor < static_cast<float>(map.rows - 2));
  const Ints corner = (truncated(y_floor) - 1) * map.width + truncated(x_floor) - 1;
  int32_t corners[kWide];
  float a[kWide], b[kWide], heights[kWide], slopes_x[kWide], slopes_y[kWide], lit[kWide];
  store(corners, corner);
  store(a, x - x_floor);
  store(b, y - y_floor);
  store(heights, height);
  store(slopes_x, slope_x);
  store(slopes_y, slope_y);
  store(lit, all(1.0f));
  for (uint32_t left = bits_of(inside); left != 0; left &= left - 1) {
    const int k = __builtin_ctz(left);
    lit[k] = 1 - (1 / 9.0f) * shaded_ninths(map.heights + corners[k], map.width, a[k], b[k],
                                            heights[k], slopes_x[k], slopes_y[k]);
  }
  return load(lit);
}

inline Floats openness(const Openness &map, Floats x, Floats y) {
  if (map.share == nullptr)
    return all(1.0f);
  const Floats column = (x - map.west_m) / map.cell_m, row = (y - map.south_m) / map.cell_m;
  const Floats column_floor = floor_of(column), row_floor = floor_of(row);
  const Ints inside = (column_floor >= 0) & (row_floor >= 0) &
                      (column_floor < static_cast<float>(map.width - 1)) &
                      (row_floor < static_cast<float>(map.height - 1));
  const Ints at = inside & (truncated(row_floor) * map.width + truncated(column_floor));
  const Addresses first = addresses_of(map.share, at);
  const Pairs here = load_pairs(first), next = load_pairs(first + int64_t{4} * map.width);
  const Floats a = column - column_floor, b = row - row_floor;
  const Floats found = mix(mix(as_floats(here.left), as_floats(here.right), a),
                           mix(as_floats(next.left), as_floats(next.right), a), b);
  return inside ? found : all(0.7f);
}

// Whether a lamp's light reaches points, from the face of its depth map that looks there.
inline Floats lamplit(const Lamp &lamp, const Vec &from_lamp) {
  if (lamp.depth == nullptr)
    return all(1.0f);
  const Floats ax = magnitude(from_lamp.x), ay = magnitude(from_lamp.y), down = -from_lamp.z;
  const Ints is_below = (down >= ax) & (down >= ay), along_x = ax >= ay;
  const Ints east = from_lamp.x > 0, north = from_lamp.y > 0;
  const Floats x_right = east ? -from_lamp.y : from_lamp.y;
  const Floats y_right = north ? from_lamp.x : -from_lamp.x;
  const Floats forward = is_below ? down : (along_x ? ax : ay);
  const Floats right = is_below ? from_lamp.x : (along_x ? x_right : y_right);
  const Floats below = is_below ? -from_lamp.y : down;
  const Ints face = ~is_below & ((along_x & (2 + east)) | (~along_x & (4 + north)));
  constexpr float kHalf = 0.5f * kLampFace;
  const Floats least = all(-1.0f), most = all(static_cast<float>(kLampFace));
  const Floats x = smaller(larger(kHalf - 0.5f + kHalf * right / forward, least), most);
  const Floats y = smaller(larger(kHalf - 0.5f + kHalf * below / forward, least), most);
  const Floats last = all(static_cast<float>(kLampFace - 2));
  const Floats i = smaller(larger(floor_of(x), Floats{}), last);
  const Floats j = smaller(larger(floor_of(y), Floats{}), last);
  const Floats a = clamp01(x - i), b = clamp01(y - j);
  const Addresses first =
      addresses_of(lamp.depth, (face * kLampFace + truncated(j)) * kLampFace + truncated(i));
  const Pairs here = load_pairs(first), next = load_pairs(first + 4 * kLampFace);
  const Floats limit = 1.02f / (forward - 0.04f), one = all(1.0f);
  const Floats top = mix(where(as_floats(here.left) < limit, one),
                         where(as_floats(here.right) < limit, one), a);
  const Floats bottom = mix(where(as_floats(next.left) < limit, one),
                            where(as_floats(next.right) < limit, one), a);
  return mix(top, bottom, b);
}

inline Floats mirror(Floats cosine) { // Schlick, of water and glass
  const Floats c = 1 - clamp01(cosine), c2 = c * c;
  return 0.03f + 0.97f * c2 * c2 * c;
}

// A light's streak on a wet surface: Blinn-Phong's half vector draws it out towards the eye.
inline Floats streak(const Point &point, const Vec &to_light, float sharpness) {
  const Vec half = to_light + point.to_eye;
  const Floats length2 = dot(half, half);
  const Floats c = dot(half, point.flat_normal) / root(larger(length2, all(1e-6f)));
  return where((c > 0) & (length2 >= 1e-6f), exp_of(sharpness * (c - 1)));
}

struct Shine {
  Floats diffuse, gloss;
};

// Adds one lamp's light to those of the points that are in its cell.
inline void add_lamp(Shine &shine, const Lamp &lamp, const Point &point, Ints here) {
  const Vec to_lamp = everywhere(lamp.position) - point.at;
  const Floats d2 = dot(to_lamp, to_lamp), facing = dot(to_lamp, point.normal);
  const float range2 = lamp.range * lamp.range;
  const Ints through = point.has(kTranslucent), is_wet = point.wet > 0;
  const Ints reached = here & (d2 <= range2) & (to_lamp.z >= -0.3f) &
                       ((facing > 0) | is_wet | through);
  if (!any(reached))
    return;
  const Floats inverse = 1 / root(d2 + 1e-4f), down = clamp01(to_lamp.z * inverse + 0.08f);
  const Floats cosine = facing * inverse;
  const Floats lean = through ? 0.3f + 0.7f * magnitude(cosine) : cosine;
  const Floats fade = 1 - d2 / range2;
  const Floats power = where(reached, lamp.power * down * fade * fade / (d2 + 0.3f));
  const Floats seen = lamplit(lamp, 0.12f * point.flat_normal - to_lamp);
  shine.diffuse += where(lean > 0, power * lean * seen);
  if (any(is_wet & (power * seen > 0)))
    shine.gloss += where(is_wet, 5 * power * seen * streak(point, inverse * to_lamp, 160));
}

inline Shine lamps_at(const Frame &frame, const Point &point) {
  Shine shine = {};
  const LampGrid &grid = frame.world.lamp_grid;
  if (grid.starts == nullptr)
    return shine;
  const Floats column = floor_of((point.at.x - grid.west_m) / kLampCell_m);
  const Floats row = floor_of((point.at.y - grid.south_m) / kLampCell_m);
  const Ints inside = (column >= 0) & (row >= 0) & (column < static_cast<float>(grid.width)) &
                      (row < static_cast<float>(grid.height));
  const Ints cell = truncated(row) * grid.width + truncated(column);
  int32_t cells[kWide];
  store(cells, cell);
  for (uint32_t left = bits_of(inside); left != 0;) {
    const int32_t this_cell = cells[__builtin_ctz(left)];
    const Ints here = inside & (cell == this_cell);
    for (int32_t k = grid.starts[this_cell]; k < grid.starts[this_cell + 1]; ++k)
      add_lamp(shine, frame.world.lamps[grid.lamps[k]], point, here);
    left &= ~bits_of(here);
  }
  return shine;
}

inline Floats headlights_at(const Light &light, const Point &point) {
  Floats diffuse = {};
  const Vec beam = everywhere(light.vehicle + 6);
  for (int side = 0; side < 2; ++side) {
    const Vec to_lamp = everywhere(light.vehicle + 3 * side) - point.at;
    const Floats d2 = dot(to_lamp, to_lamp) + 0.2f, inverse = 1 / root(d2);
    const Floats within = -dot(to_lamp, beam) * inverse;
    const Ints reached = within >= 0.6f;
    if (!any(reached))
      continue;
    const Floats facing = dot(to_lamp, point.normal) * inverse;
    // Dipped: a cut-off a little above the horizontal.
    const Floats dipped = 1 - 0.85f * smooth(-0.02f, 0.05f, -to_lamp.z * inverse);
    const Floats power = 6 * light.headlights * power8(within) * dipped / (d2 + 6);
    diffuse += where(reached & (facing > 0), power * facing);
  }
  return diffuse;
}

// Snow lies where surfaces look up; traffic wears tracks into it and patches melt first.
inline Floats snow_cover(const Frame &frame, const Point &point) {
  const int32_t *noise = frame.world.noise_quads;
  const Floats patch = noise_at(noise, 1.9f * point.at.x, 1.9f * point.at.y) * 0.6f +
                       noise_at(noise, 7.7f * point.at.x, 7.7f * point.at.y) * 0.4f;
  Floats amount = all(frame.light.snow);
  amount = point.has(kCrossroad) ? amount * 0.88f : amount;
  const Ints road = point.has(kRoad);
  if (any(road)) { // two tracks on each side, worn out and winding a little
    const Floats wind = 0.02f * noise_at(noise, 0.8f * point.at.x + 31, 0.8f * point.at.y);
    const Floats half = magnitude(point.across - 0.5f + wind);
    const Floats track = magnitude(magnitude(half - 0.17f) - 0.075f);
    amount = road ? amount * (0.35f + 0.65f * smooth(0.015f, 0.05f, track)) : amount;
  }
  const Floats lies =
      smooth(0.62f - 0.75f * amount, 0.8f - 0.75f * amount, 0.25f + 0.5f * patch);
  return lies * smooth(0.35f, 0.75f, point.normal.z);
}

inline Floats water_film(const Frame &frame, const Point &point) {
  const Ints level = point.flat_normal.z >= 0.5f;
  if (frame.light.wet <= 0 || !any(level))
    return Floats{};
  const Floats puddle = noise_at(frame.world.noise_quads, 0.6f * point.at.x + 71,
                                 0.6f * point.at.y + 13);
  return where(level, frame.light.wet * (0.25f + 0.75f * smooth(0.5f, 0.62f, puddle)));
}

// What a mirror direction sees: the sky, or the front of the street.
inline Floats reflected(const Frame &frame, const Point &point) {
  const Vec r = (2 * dot(point.flat_normal, point.to_eye)) * point.flat_normal - point.to_eye;
  const Floats front = all(0.22f * frame.light.sky_power + 0.05f * frame.light.sun_power);
  const Floats above = smooth(0.25f, 0.5f, r.z + 0.03f * point.at.z);
  return any(above > 0) ? mix(front, sky(frame, r), above) : front;
}

inline Floats ambient(const Frame &frame, const Point &point) {
  const Light &light = frame.light;
  const Floats out_m = where(point.flat_normal.z <= 0.7f, all(0.6f));
  const Floats ground =
      openness(frame.world.openness, point.at.x + out_m * point.flat_normal.x,
               point.at.y + out_m * point.flat_normal.y);
  const Floats height = larger(point.at.z, Floats{});
  const Floats open = 1 - (1 - ground) * exp_of(-0.22f * height);
  const Floats from_sky = light.sky_power * open * (0.92f + 0.08f * point.normal.z);
  const Floats bounced = (0.12f * light.sky_power + 0.04f * light.sun_power) * (0.4f + 0.6f * open);
  return from_sky + bounced;
}

inline Floats sunshine(const Frame &frame, const Point &point) {
  if (frame.light.sun_power <= 0)
    return Floats{};
  const Vec sun = everywhere(frame.light.sun);
  const Ints leaf = point.has(kTranslucent);
  Floats facing = dot(point.normal, sun);
  facing = leaf ? 0.25f + 0.6f * magnitude(facing) : facing;
  const Ints turned = (facing > 0) & (leaf | (dot(point.flat_normal, sun) > 0));
  if (!any(turned))
    return Floats{};
  const Floats off = leaf ? all(0.12f) : 0.02f + 0.0004f * point.distance_m;
  const Vec near = point.from_eye + off * point.flat_normal + off * sun;
  const Vec &flat = point.flat_normal; // leaves stand in each other's way at random
  const Vec plane = {leaf ? sun.x : flat.x, leaf ? sun.y : flat.y, leaf ? sun.z : flat.z};
  Floats lit = all(1.0f);
  if (frame.sun_static.heights != nullptr)
    lit = sunlit(frame.sun_static, near, plane, turned);
  const Ints still_lit = turned & (lit > 0);
  if (frame.sun_moving.heights != nullptr && any(still_lit))
    lit *= sunlit(frame.sun_moving, near, plane, still_lit);
  lit += frame.light.aureole * (1 - lit);
  return where(turned, frame.light.sun_power * facing * lit);
}

inline Floats fogged(const Light &light, Floats luminance, Floats distance_m) {
  if (light.fog_per_m <= 0)
    return luminance;
  const Floats through = exp_of(-light.fog_per_m * distance_m);
  return luminance * through + light.haze * light.sky_power * (1 - through);
}

} // namespace engram::ENGRAM_ISA::wide
