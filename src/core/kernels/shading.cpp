#include "kernels/shading.hpp"

#include <math.h>
#include <string.h>

namespace engram::ENGRAM_ISA {
namespace {

typedef float f32x4 __attribute__((vector_size(16)));
typedef int32_t i32x4 __attribute__((vector_size(16)));
typedef float f32x16 __attribute__((vector_size(64)));
typedef int32_t i32x16 __attribute__((vector_size(64)));
typedef uint32_t u32x4 __attribute__((vector_size(16)));

struct Vec {
  float x, y, z;
};
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec vec(const float *p) { return {p[0], p[1], p[2]}; }
inline float clamp01(float x) { return x < 0 ? 0 : x > 1 ? 1 : x; }
inline float mix(float a, float b, float s) { return a + (b - a) * s; }
inline float smooth(float low, float high, float x) {
  const float s = clamp01((x - low) / (high - low));
  return s * s * (3 - 2 * s);
}

// 2^x within 2e-6, the same bits on every machine: no library function.
inline float exp2_of(float x) {
  x = x < -100 ? -100 : x > 100 ? 100 : x;
  const float whole = floorf(x), f = x - whole;
  const float power =
      1 + f * (0.69314718f +
               f * (0.24022651f + f * (0.05550411f + f * (0.00961813f + f * 0.00133336f))));
  const int32_t bits = (static_cast<int32_t>(whole) + 127) << 23;
  float scale;
  memcpy(&scale, &bits, 4);
  return power * scale;
}
inline float exp_of(float x) { return exp2_of(1.44269504f * x); }

// log2 within 0.01, which is plenty for a mip level.
inline float log2_of(float x) {
  int32_t bits;
  memcpy(&bits, &x, 4);
  const float exponent = static_cast<float>((bits >> 23) - 127);
  bits = (bits & 0x7fffff) | 0x3f800000;
  float m;
  memcpy(&m, &bits, 4);
  return exponent + (m - 1) * (1.3465f - 0.3465f * m);
}

inline float power8(float x) {
  x *= x;
  x *= x;
  return x * x;
}

inline uint32_t word(const uint8_t *p) {
  uint32_t bytes;
  memcpy(&bytes, p, 4);
  return bytes;
}

// The four texels around a place, each times its weight: lanes 4k … 4k + 3 are texel k's channels,
// still scaled by where their byte stands in the word (`gathered` undoes it). Compilers turn a
// conversion of bytes to floats into single bytes; masks and one conversion of words stay vectors.
inline f32x16 tap(const Texture &texture, int32_t level, float u, float v, float weight) {
  const int32_t width = texture.widths[level], height = texture.heights[level];
  const float x = (u - floorf(u)) * static_cast<float>(width) - 0.5f;
  const float y = (v - floorf(v)) * static_cast<float>(height) - 0.5f;
  const float x_floor = floorf(x), y_floor = floorf(y);
  int32_t i0 = static_cast<int32_t>(x_floor), j0 = static_cast<int32_t>(y_floor);
  const int32_t i1 = i0 + 1 < width ? i0 + 1 : 0, j1 = j0 + 1 < height ? j0 + 1 : 0;
  i0 = i0 < 0 ? width - 1 : i0;
  j0 = j0 < 0 ? height - 1 : j0;
  const float a = x - x_floor, b = y - y_floor;
  const uint8_t *row0 = texture.levels[level] + 4 * static_cast<int64_t>(j0) * width;
  const uint8_t *row1 = texture.levels[level] + 4 * static_cast<int64_t>(j1) * width;
  const u32x4 words = {word(row0 + 4 * i0), word(row0 + 4 * i1), word(row1 + 4 * i0),
                       word(row1 + 4 * i1)};
  const i32x4 low = reinterpret_cast<i32x4>(words), high = reinterpret_cast<i32x4>(words >> 8);
  constexpr int32_t b0 = 0xff, b1 = 0xff00, b2 = 0xff0000;
  const i32x16 masks = {b0, b1, b2, b2, b0, b1, b2, b2, b0, b1, b2, b2, b0, b1, b2, b2};
  const i32x16 lanes =
      __builtin_shufflevector(low, high, 0, 0, 0, 4, 1, 1, 1, 5, 2, 2, 2, 6, 3, 3, 3, 7) & masks;
  const f32x16 values = __builtin_convertvector(lanes, f32x16);
  const float top = weight * (1 - b), bottom = weight * b;
  const f32x4 corner = {top * (1 - a), top * a, bottom * (1 - a), bottom * a};
  const f32x16 weights =
      __builtin_shufflevector(corner, corner, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
  return values * weights;
}

inline f32x4 gathered(f32x16 sum) {
  const f32x4 q0 = __builtin_shufflevector(sum, sum, 0, 1, 2, 3);
  const f32x4 q1 = __builtin_shufflevector(sum, sum, 4, 5, 6, 7);
  const f32x4 q2 = __builtin_shufflevector(sum, sum, 8, 9, 10, 11);
  const f32x4 q3 = __builtin_shufflevector(sum, sum, 12, 13, 14, 15);
  const f32x4 places = {1, 1.0f / (1 << 8), 1.0f / (1 << 16), 1.0f / (1 << 16)};
  return ((q0 + q1) + (q2 + q3)) * places;
}

struct Texels {
  float albedo, slope_u, slope_v, special;
};

constexpr int kMaxTaps = 5;

// Anisotropic: taps along the long axis of the pixel's footprint, each of the size of the short
// one.
Texels sample(const Texture &texture, const Surface &surface, float u, float v, Vec along,
              float minor_m, float stretch) {
  const Vec u_axis = vec(surface.along_u), v_axis = vec(surface.along_v);
  int taps = static_cast<int>(stretch + 0.5f);
  taps = taps < 1 ? 1 : taps > kMaxTaps ? kMaxTaps : taps;
  const float major_m = minor_m * stretch, step_m = major_m / static_cast<float>(taps);
  const float u_per_m2 = dot(u_axis, u_axis), v_per_m2 = dot(v_axis, v_axis);
  const float width = static_cast<float>(texture.widths[0]),
              height = static_cast<float>(texture.heights[0]);
  const float u_texels2 = u_per_m2 * width * width, v_texels2 = v_per_m2 * height * height;
  const float per_m = sqrtf(u_texels2 > v_texels2 ? u_texels2 : v_texels2);
  // A quarter more than a pixel: sharper, the grid of texels beats with that of pixels.
  const float size = 1.25f * (step_m > minor_m ? step_m : minor_m) * per_m;
  float level = size > 1 ? log2_of(size) : 0;
  const float top = static_cast<float>(texture.level_count - 1);
  level = level > top ? top : level;
  const int32_t fine = static_cast<int32_t>(level);
  const int32_t coarse = fine + 1 < texture.level_count ? fine + 1 : fine;
  // One level alone near each whole number, a blend of two half way between.
  const float blend = clamp01(2 * (level - static_cast<float>(fine)) - 0.5f);
  const float du = dot(u_axis, along) * step_m, dv = dot(v_axis, along) * step_m;
  const float share = 1.0f / static_cast<float>(taps);
  const float fine_share = coarse == fine ? share : share * (1 - blend);
  const float coarse_share = coarse == fine ? 0 : share * blend;
  f32x16 texels = {};
  for (int k = 0; k < taps; ++k) {
    const float s = static_cast<float>(k) - 0.5f * static_cast<float>(taps - 1);
    if (fine_share > 0)
      texels += tap(texture, fine, u + du * s, v + dv * s, fine_share);
    if (coarse_share > 0)
      texels += tap(texture, coarse, u + du * s, v + dv * s, coarse_share);
  }
  const f32x4 sum = gathered(texels);
  return {sum[0] * (1 / 255.0f), (sum[1] - 128) * (1 / 100.0f), (sum[2] - 128) * (1 / 100.0f),
          sum[3] * (1 / 255.0f)};
}

// Smooth noise in 0…1 that tiles; one unit is one of its 256 texels.
inline float noise_at(const uint8_t *noise, float x, float y) {
  const float x_floor = floorf(x), y_floor = floorf(y);
  const int32_t i0 = static_cast<int32_t>(x_floor) & 255, j0 = static_cast<int32_t>(y_floor) & 255;
  const int32_t i1 = (i0 + 1) & 255, j1 = (j0 + 1) & 255;
  const float a = x - x_floor, b = y - y_floor;
  const float top = mix(noise[256 * j0 + i0], noise[256 * j0 + i1], a);
  const float bottom = mix(noise[256 * j1 + i0], noise[256 * j1 + i1], a);
  return mix(top, bottom, b) * (1 / 255.0f);
}

// Luminance of the sky towards a unit direction; a dark rim of far trees and hills below.
float sky(const Surroundings &world, const Light &light, Vec d) {
  const float level = sqrtf(d.x * d.x + d.y * d.y) + 1e-6f;
  const float rim =
      0.012f + 0.07f * noise_at(world.noise, 128 + 90 * d.x / level, 128 + 90 * d.y / level);
  if (d.z < rim * level)
    return 0.28f * light.sky_power + 0.02f * light.sun_power;
  const float up = d.z > 0.02f ? d.z : 0.02f;
  const float towards_sun = dot(d, vec(light.sun));
  const float around = towards_sun > 0 ? towards_sun : 0;
  const float glow = power8(around), disc = power8(glow * glow);
  float blue =
      light.sky_power * (1.15f - 0.5f * sqrtf(up)) + light.sun_power * (0.12f * glow + 0.9f * disc);
  if (light.cloud <= 0.01f)
    return blue;
  const float x = d.x / (up + 0.12f) * 22 + light.cloud_shift[0];
  const float y = d.y / (up + 0.12f) * 22 + light.cloud_shift[1];
  const float field = 0.62f * noise_at(world.noise, x, y) +
                      0.28f * noise_at(world.noise, 2.3f * x + 37, 2.3f * y + 11) +
                      0.1f * noise_at(world.noise, 6.1f * x + 5, 6.1f * y + 91);
  const float edge = 0.97f - 1.05f * light.cloud;
  const float cover = smooth(edge - 0.09f, edge + 0.09f, field);
  const float lit =
      (0.62f + 0.45f * (1 - field) + 0.2f * up) * (light.sky_power + 0.09f * light.sun_power);
  return mix(blue, 1.15f * lit, cover);
}

// Share of the sun that reaches a point: a 3×3 tent over the map's texels, which is about as wide
// as the sun's own penumbra ten metres behind an edge. Each texel is compared with the height that
// the receiving plane itself has there: a plane never shades itself, whatever its tilt, and shadows
// stay attached with a small bias.
float sunlit(const DepthMap &map, Vec p, Vec normal) {
  if (map.heights == nullptr)
    return 1;
  const double *axes = map.window.axes;
  const Vec right = {static_cast<float>(axes[0]), static_cast<float>(axes[1]),
                     static_cast<float>(axes[2])};
  const Vec below = {static_cast<float>(axes[4]), static_cast<float>(axes[5]),
                     static_cast<float>(axes[6])};
  const Vec up = {static_cast<float>(axes[8]), static_cast<float>(axes[9]),
                  static_cast<float>(axes[10])};
  const float facing = dot(normal, up), steepest = 0.05f;
  const float scale = -1 / (dot(right, right) * (facing > steepest ? facing : steepest));
  const float slope_x = scale * dot(normal, right), slope_y = scale * dot(normal, below);
  const float x = static_cast<float>(axes[0] * p.x + axes[1] * p.y + axes[2] * p.z + axes[3]);
  const float y = static_cast<float>(axes[4] * p.x + axes[5] * p.y + axes[6] * p.z + axes[7]);
  const float height =
      static_cast<float>(axes[8] * p.x + axes[9] * p.y + axes[10] * p.z + axes[11]);
  const float x_floor = floorf(x), y_floor = floorf(y);
  const int32_t i = static_cast<int32_t>(x_floor), j = static_cast<int32_t>(y_floor);
  if (i < 1 || j < 1 || i + 2 >= map.window.width || j + 2 >= map.window.height)
    return 1;
  const float a = x - x_floor, b = y - y_floor;
  const f32x4 across = {1 - a, 1, 1, a};
  const float down[4] = {1 - b, 1, 1, b};
  const f32x4 columns = {-1 - a, -a, 1 - a, 2 - a};
  f32x4 shaded = {0, 0, 0, 0};
  for (int row = 0; row < 4; ++row) {
    const f32x4 plane = columns * slope_x + (height + slope_y * (static_cast<float>(row - 1) - b));
    f32x4 heights;
    memcpy(&heights, map.heights + static_cast<int64_t>(j - 1 + row) * map.window.width + i - 1,
           16);
    const f32x4 weights = across * down[row];
    shaded += reinterpret_cast<f32x4>(reinterpret_cast<i32x4>(weights) & (heights > plane));
  }
  const float sum = (shaded[0] + shaded[1]) + (shaded[2] + shaded[3]);
  return 1 - sum * (1 / 9.0f);
}

float openness(const Openness &map, float x, float y) {
  if (map.share == nullptr)
    return 1;
  const float column = (x - map.west_m) / map.cell_m, row = (y - map.south_m) / map.cell_m;
  const float x_floor = floorf(column), y_floor = floorf(row);
  const int32_t i = static_cast<int32_t>(x_floor), j = static_cast<int32_t>(y_floor);
  if (i < 0 || j < 0 || i + 1 >= map.width || j + 1 >= map.height)
    return 0.7f;
  const float *at = map.share + static_cast<int64_t>(j) * map.width + i;
  const float a = column - x_floor, b = row - y_floor;
  return mix(mix(at[0], at[1], a), mix(at[map.width], at[map.width + 1], a), b);
}

// Whether a lamp's light reaches a point, from the face of its depth map that looks there.
float lamplit(const Lamp &lamp, Vec from_lamp) {
  if (lamp.depth == nullptr)
    return 1;
  const float ax = fabsf(from_lamp.x), ay = fabsf(from_lamp.y), down = -from_lamp.z;
  int face;
  float forward, right, below;
  if (down >= ax && down >= ay) {
    face = 0, forward = down, right = from_lamp.x, below = -from_lamp.y;
  } else if (ax >= ay) {
    face = from_lamp.x > 0 ? 1 : 2, forward = ax;
    right = from_lamp.x > 0 ? -from_lamp.y : from_lamp.y, below = down;
  } else {
    face = from_lamp.y > 0 ? 3 : 4, forward = ay;
    right = from_lamp.y > 0 ? from_lamp.x : -from_lamp.x, below = down;
  }
  constexpr float kHalf = 0.5f * kLampFace;
  const float x = kHalf - 0.5f + kHalf * right / forward,
              y = kHalf - 0.5f + kHalf * below / forward;
  int32_t i = static_cast<int32_t>(floorf(x)), j = static_cast<int32_t>(floorf(y));
  i = i < 0 ? 0 : i > kLampFace - 2 ? kLampFace - 2 : i;
  j = j < 0 ? 0 : j > kLampFace - 2 ? kLampFace - 2 : j;
  const float a = clamp01(x - static_cast<float>(i)), b = clamp01(y - static_cast<float>(j));
  const float *at = lamp.depth + (static_cast<int64_t>(face) * kLampFace + j) * kLampFace + i;
  const float limit = 1.02f / (forward - 0.04f);
  const float top = mix(at[0] < limit, at[1] < limit, a);
  const float bottom = mix(at[kLampFace] < limit, at[kLampFace + 1] < limit, a);
  return mix(top, bottom, b);
}

// What a sample stands on and how it is seen.
struct Point {
  Vec at, to_eye, flat_normal, normal;
  float cosine; // between flat normal and to_eye
  float distance_m;
  uint32_t flags;
  float wet;    // how much of a water film lies here
  float across; // where on a carriageway, 0…1 between its kerbs
};

float mirror(float cosine) { // Schlick, of water and glass
  const float c = 1 - clamp01(cosine), c2 = c * c;
  return 0.03f + 0.97f * c2 * c2 * c;
}

// A light's streak on a wet surface: Blinn-Phong's half vector draws it out towards the eye.
float streak(const Point &point, Vec to_light, float sharpness) {
  const Vec half = to_light + point.to_eye;
  const float length2 = dot(half, half);
  if (length2 < 1e-6f)
    return 0;
  const float c = dot(half, point.flat_normal) / sqrtf(length2);
  return c > 0 ? exp_of(sharpness * (c - 1)) : 0;
}

struct Shine {
  float diffuse, gloss;
};

Shine lamps_at(const Surroundings &world, const Point &point) {
  Shine shine = {0, 0};
  const LampGrid &grid = world.lamp_grid;
  const auto column = static_cast<int32_t>((point.at.x - grid.west_m) / kLampCell_m);
  const auto row = static_cast<int32_t>((point.at.y - grid.south_m) / kLampCell_m);
  if (grid.starts == nullptr || point.at.x < grid.west_m || point.at.y < grid.south_m ||
      column >= grid.width || row >= grid.height)
    return shine;
  const int32_t *start = grid.starts + row * grid.width + column;
  for (int32_t k = start[0]; k < start[1]; ++k) {
    const Lamp &lamp = world.lamps[grid.lamps[k]];
    const Vec to_lamp = vec(lamp.position) - point.at;
    const float d2 = dot(to_lamp, to_lamp), range2 = lamp.range * lamp.range;
    const float facing = dot(to_lamp, point.normal);
    const bool through = point.flags & kTranslucent;
    if (d2 > range2 || to_lamp.z < -0.3f || (facing <= 0 && point.wet <= 0 && !through))
      continue;
    const float inverse = 1 / sqrtf(d2 + 1e-4f), down = clamp01(to_lamp.z * inverse + 0.08f);
    const float cosine = facing * inverse;
    const float lean = through ? 0.3f + 0.7f * fabsf(cosine) : cosine;
    const float fade = 1 - d2 / range2;
    const float power = lamp.power * down * fade * fade / (d2 + 0.3f);
    const float seen = lamplit(lamp, (-1.0f) * to_lamp + 0.12f * point.flat_normal);
    shine.diffuse += lean > 0 ? power * lean * seen : 0;
    if (point.wet > 0 && seen > 0)
      shine.gloss += 5 * power * seen * streak(point, inverse * to_lamp, 160);
  }
  return shine;
}

Shine headlights_at(const Light &light, const Point &point) {
  Shine shine = {0, 0};
  const Vec beam = vec(light.vehicle + 6);
  for (int side = 0; side < 2; ++side) {
    const Vec to_lamp = vec(light.vehicle + 3 * side) - point.at;
    const float d2 = dot(to_lamp, to_lamp) + 0.2f, inverse = 1 / sqrtf(d2);
    const float inside = -dot(to_lamp, beam) * inverse;
    if (inside < 0.6f)
      continue;
    const float facing = dot(to_lamp, point.normal) * inverse;
    // Dipped: a cut-off a little above the horizontal.
    const float dipped = 1 - 0.85f * smooth(-0.02f, 0.05f, -to_lamp.z * inverse);
    const float power = 6 * light.headlights * power8(inside) * dipped / (d2 + 6);
    shine.diffuse += facing > 0 ? power * facing : 0;
  }
  return shine;
}

// Snow lies where surfaces look up; traffic wears tracks into it and patches melt first.
float snow_cover(const Surroundings &world, const Light &light, const Point &point) {
  const float patch = noise_at(world.noise, 1.9f * point.at.x, 1.9f * point.at.y) * 0.6f +
                      noise_at(world.noise, 7.7f * point.at.x, 7.7f * point.at.y) * 0.4f;
  float amount = light.snow;
  if (point.flags & kCrossroad)
    amount *= 0.88f;
  if (point.flags & kRoad) { // two tracks on each side, worn out and winding a little
    const float wind = 0.02f * noise_at(world.noise, 0.8f * point.at.x + 31, 0.8f * point.at.y);
    const float half = fabsf(point.across - 0.5f + wind);
    const float track = fabsf(fabsf(half - 0.17f) - 0.075f);
    amount *= 0.35f + 0.65f * smooth(0.015f, 0.05f, track);
  }
  const float lies = smooth(0.62f - 0.75f * amount, 0.8f - 0.75f * amount, 0.25f + 0.5f * patch);
  return lies * smooth(0.35f, 0.75f, point.normal.z);
}

float water_film(const Surroundings &world, const Light &light, const Point &point) {
  if (light.wet <= 0 || point.flat_normal.z < 0.5f)
    return 0;
  const float puddle = noise_at(world.noise, 0.6f * point.at.x + 71, 0.6f * point.at.y + 13);
  return light.wet * (0.25f + 0.75f * smooth(0.5f, 0.62f, puddle));
}

// What a mirror direction sees: the sky, or the front of the street.
float reflected(const Surroundings &world, const Light &light, const Point &point) {
  const Vec r = 2 * dot(point.flat_normal, point.to_eye) * point.flat_normal - point.to_eye;
  const float front = 0.22f * light.sky_power + 0.05f * light.sun_power;
  const float above = smooth(0.25f, 0.5f, r.z + 0.03f * point.at.z);
  return above <= 0 ? front : mix(front, sky(world, light, r), above);
}

float ambient(const Surroundings &world, const Light &light, const Point &point) {
  const float out_m = point.flat_normal.z > 0.7f ? 0.0f : 0.6f;
  const float ground = openness(world.openness, point.at.x + out_m * point.flat_normal.x,
                                point.at.y + out_m * point.flat_normal.y);
  const float height = point.at.z > 0 ? point.at.z : 0;
  const float open = 1 - (1 - ground) * exp_of(-0.22f * height);
  const float from_sky = light.sky_power * open * (0.92f + 0.08f * point.normal.z);
  const float bounced = (0.12f * light.sky_power + 0.10f * light.sun_power) * (0.4f + 0.6f * open);
  return from_sky + bounced;
}

// Share of the sun's light that comes from the bright haze around it and from sunlit walls about: it
// falls from the sun's side, so that relief shows in the shade too, and shadows do not take it.
constexpr float kAureole = 0.5f;

float sunshine(const Surroundings &world, const Light &light, const Point &point) {
  if (light.sun_power <= 0)
    return 0;
  const Vec sun = vec(light.sun);
  float facing = dot(point.normal, sun);
  if (point.flags & kTranslucent)
    facing = 0.25f + 0.6f * fabsf(facing);
  else if (dot(point.flat_normal, sun) <= 0)
    return 0;
  if (facing <= 0)
    return 0;
  const bool leaf = point.flags & kTranslucent;
  const float off = leaf ? 0.12f : 0.02f + 0.0004f * point.distance_m;
  const Vec near = point.at + off * point.flat_normal + off * sun;
  const Vec plane = leaf ? sun : point.flat_normal; // leaves stand in each other's way at random
  float lit = sunlit(world.sun_static, near, plane);
  if (lit > 0 && world.sun_moving.heights != nullptr)
    lit *= sunlit(world.sun_moving, near, plane);
  lit += kAureole * (1 - lit);
  return light.sun_power * facing * lit;
}

float fogged(const Light &light, float luminance, float distance_m) {
  if (light.fog_per_m <= 0)
    return luminance;
  const float through = exp_of(-light.fog_per_m * distance_m);
  return luminance * through + light.haze * light.sky_power * (1 - through);
}

// Bends the normal by the texture's slopes.
Vec bumped(const Surface &surface, Vec normal, float slope_u, float slope_v) {
  const Vec u = vec(surface.along_u), v = vec(surface.along_v);
  const float u_scale = slope_u / sqrtf(dot(u, u) + 1e-12f),
              v_scale = slope_v / sqrtf(dot(v, v) + 1e-12f);
  const Vec bent = normal + u_scale * u + v_scale * v;
  return (1 / sqrtf(dot(bent, bent))) * bent;
}

float shade_point(const Surroundings &world, const Light &light, const Surface &surface,
                  Point &point, const Texels &texels) {
  float albedo = texels.albedo * surface.tint;
  albedo = albedo > 0.95f ? 0.95f : albedo;
  if (light.snow > 0) {
    const float snow = snow_cover(world, light, point);
    albedo = mix(albedo, 0.82f, snow);
    point.normal = point.normal + 0.7f * snow * (point.flat_normal - point.normal);
  }
  point.wet = water_film(world, light, point);
  if (light.wet > 0)
    albedo *= 1 - light.wet * (point.flat_normal.z > 0.5f ? 0.42f : 0.15f);
  Shine shine = lamps_at(world, point);
  if (light.headlights > 0)
    shine.diffuse += headlights_at(light, point).diffuse;
  float luminance =
      albedo * (ambient(world, light, point) + sunshine(world, light, point) + shine.diffuse);
  if (surface.glow > 0)
    luminance += surface.glow * light.windows * texels.special * (0.15f + 1.2f * texels.albedo);
  if ((surface.flags & kGlass) && texels.special > 0.02f)
    luminance += texels.special * (0.03f + mirror(point.cosine)) * reflected(world, light, point);
  if (point.wet > 0)
    luminance += point.wet * (mirror(point.cosine) * reflected(world, light, point) + shine.gloss);
  return fogged(light, luminance, point.distance_m);
}

struct Eye {
  Vec at;
  float rotation[9];
  float fx, fy, cx, cy, pixel_rad;
};

float shade_sample(const Surroundings &world, const Light &light, const Eye &eye, int32_t id,
                   float x_px, float y_px) {
  const float a = (x_px - eye.cx) / eye.fx, b = (y_px - eye.cy) / eye.fy;
  const Vec ray = {eye.rotation[0] * a + eye.rotation[1] * b + eye.rotation[2],
                   eye.rotation[3] * a + eye.rotation[4] * b + eye.rotation[5],
                   eye.rotation[6] * a + eye.rotation[7] * b + eye.rotation[8]};
  const float stretch_of_ray = sqrtf(a * a + b * b + 1);
  const Vec towards = (1 / stretch_of_ray) * ray;
  if (id < 0)
    return fogged(light, sky(world, light, towards), towards.z > 0.02f ? 25 / towards.z : 1200);
  const Surface &surface = world.meshes[id >> kIndexBits].surfaces[id & ((1 << kIndexBits) - 1)];
  Vec normal = vec(surface.normal);
  float cosine = -dot(normal, towards);
  const float above = dot(normal, eye.at) + surface.offset;
  Point point;
  point.distance_m = fabsf(above / (fabsf(cosine) > 1e-5f ? cosine : 1e-5f));
  if (cosine < 0) {
    normal = (-1.0f) * normal;
    cosine = -cosine;
  }
  cosine = cosine < 0.02f ? 0.02f : cosine;
  point.at = eye.at + point.distance_m * towards;
  point.to_eye = (-1.0f) * towards;
  point.flat_normal = normal;
  point.cosine = cosine;
  point.flags = surface.flags;
  const Texture &texture = world.textures[surface.texture];
  const Vec slide = towards + cosine * normal; // the ray's shadow on the surface
  const Vec along = (1 / sqrtf(dot(slide, slide) + 1e-12f)) * slide;
  const float u = dot(vec(surface.along_u), point.at) + surface.u_at_origin;
  const float v = dot(vec(surface.along_v), point.at) + surface.v_at_origin;
  point.across = u;
  const Texels texels =
      sample(texture, surface, u, v, along, point.distance_m * eye.pixel_rad, 1 / cosine);
  point.normal = bumped(surface, normal, texels.slope_u, texels.slope_v);
  return shade_point(world, light, surface, point, texels);
}

// Shades each distinct surface among the pixel's samples once.
float shade_pixel(const Surroundings &world, const Light &light, const Eye &eye, const View &view,
                  const int32_t *ids, int32_t x, int32_t y) {
  const int32_t n = view.samples;
  const int64_t stride = static_cast<int64_t>(view.width) * n;
  const int32_t *corner = ids + static_cast<int64_t>(y) * n * stride + static_cast<int64_t>(x) * n;
  int32_t seen[16];
  for (int32_t j = 0; j < n; ++j)
    for (int32_t i = 0; i < n; ++i)
      seen[j * n + i] = corner[j * stride + i];
  const int32_t count = n * n;
  float sum = 0;
  for (int32_t k = 0; k < count; ++k) {
    bool done = false;
    for (int32_t m = 0; m < k; ++m)
      done = done || seen[m] == seen[k];
    if (done)
      continue;
    float x_sum = 0, y_sum = 0, weight = 0;
    for (int32_t m = k; m < count; ++m)
      if (seen[m] == seen[k]) {
        x_sum += static_cast<float>(m % n);
        y_sum += static_cast<float>(m / n);
        weight += 1;
      }
    const float inside = static_cast<float>(n);
    const float x_px = static_cast<float>(x) + (x_sum / weight + 0.5f) / inside - 0.5f;
    const float y_px = static_cast<float>(y) + (y_sum / weight + 0.5f) / inside - 0.5f;
    const float luminance = shade_sample(world, light, eye, seen[k], x_px, y_px);
    sum += weight * (luminance < 60 ? luminance : 60);
  }
  return sum / static_cast<float>(count);
}

} // namespace

void shade_view(const Surroundings &world, const Light &light, const View &view, const int32_t *ids,
                int32_t row_begin, int32_t row_end, float *luminance) {
  Eye eye;
  eye.at = {static_cast<float>(view.centre[0]), static_cast<float>(view.centre[1]),
            static_cast<float>(view.centre[2])};
  for (int i = 0; i < 9; ++i)
    eye.rotation[i] = static_cast<float>(view.rotation[i]);
  eye.fx = view.fx, eye.fy = view.fy, eye.cx = view.cx, eye.cy = view.cy;
  eye.pixel_rad = 1 / view.fx;
  for (int32_t y = row_begin; y < row_end; ++y)
    for (int32_t x = 0; x < view.width; ++x)
      luminance[static_cast<int64_t>(y) * view.width + x] =
          shade_pixel(world, light, eye, view, ids, x, y);
}

void halve_texture(const uint8_t *from, int32_t width, int32_t height, bool keep_coverage,
                   uint8_t *to) {
  const int32_t half_width = width > 1 ? width / 2 : 1, half_height = height > 1 ? height / 2 : 1;
  int64_t covered = 0;
  for (int64_t i = 0; i < static_cast<int64_t>(width) * height; ++i)
    covered += from[4 * i + 3] >= 128;
  int32_t histogram[256] = {};
  for (int32_t y = 0; y < half_height; ++y)
    for (int32_t x = 0; x < half_width; ++x) {
      // Sizes need not be even: each texel averages the span that it covers.
      const int32_t x0 = x * width / half_width, x1 = (x + 1) * width / half_width;
      const int32_t y0 = y * height / half_height, y1 = (y + 1) * height / half_height;
      int32_t sum[4] = {};
      for (int32_t j = y0; j < y1; ++j)
        for (int32_t i = x0; i < x1; ++i)
          for (int c = 0; c < 4; ++c)
            sum[c] += from[4 * (static_cast<int64_t>(j) * width + i) + c];
      const int32_t count = (x1 - x0) * (y1 - y0);
      uint8_t *texel = to + 4 * (static_cast<int64_t>(y) * half_width + x);
      for (int c = 0; c < 4; ++c)
        texel[c] = static_cast<uint8_t>((sum[c] + count / 2) / count);
      ++histogram[texel[3]];
    }
  if (!keep_coverage)
    return;
  // The threshold above which the same share as before is covered becomes 128.
  const int64_t texels = static_cast<int64_t>(half_width) * half_height;
  const int64_t wanted = covered * texels / (static_cast<int64_t>(width) * height);
  int32_t threshold = 255;
  for (int64_t above = histogram[255]; threshold > 1 && above < wanted;)
    above += histogram[--threshold];
  for (int64_t i = 0; i < texels; ++i) {
    const int32_t stretched = to[4 * i + 3] * 128 / threshold;
    to[4 * i + 3] = static_cast<uint8_t>(stretched > 255 ? 255 : stretched);
  }
}

} // namespace engram::ENGRAM_ISA
