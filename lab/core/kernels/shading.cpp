#include "kernels/shading.hpp"

#include <math.h>

#include <algorithm>
#include <cmath>


#include <vector>

#include "kernels/light_lanes.hpp"

// A pixel's samples see one surface or a few. Each of them is a fragment, shaded once. Fragments
// are sorted by what needs to be worked out for them and shaded some at a time, one to a lane.

namespace engram::ENGRAM_ISA {
namespace {

using namespace wide;

constexpr float kBrightest = 60; // of a fragment, so that one sun's reflection does not fill a pixel

enum Sort { kSky, kGround, kWall, kMirror, kLeaf, kSorts };

Sort sort_of(const Surface &surface) {
  if (surface.flags & kTranslucent)
    return kLeaf;
  if ((surface.flags & kGlass) || surface.glow > 0)
    return kMirror;
  return surface.normal[2] > 0.5f ? kGround : kWall;
}

struct Fragments {
  std::vector<const Surface *> surfaces;
  std::vector<float> x_px, y_px, weights;
  std::vector<float *> pixels; // what they add to
};

SunMap seen_from(const DepthMap &map, const double *eye) {
  SunMap seen = {};
  const double *axes = map.window.axes;
  float *const vectors[3] = {seen.right, seen.below, seen.up};
  float at[3];
  for (int k = 0; k < 3; ++k) {
    const double *axis = axes + 4 * k;
    for (int i = 0; i < 3; ++i)
      vectors[k][i] = static_cast<float>(axis[i]);
    at[k] = static_cast<float>(axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2] + axis[3]);
  }
  seen.column = at[0], seen.row = at[1], seen.height = at[2];
  seen.texel_m2 =
      static_cast<float>(1 / (axes[0] * axes[0] + axes[1] * axes[1] + axes[2] * axes[2]));
  seen.heights = map.heights, seen.width = map.window.width, seen.rows = map.window.height;
  return seen;
}

Frame frame_of(const Surroundings &world, const Light &light, const View &view) {
  Frame frame = {world, light, {}, {}, view.fx, view.fy, view.cx, view.cy, {}, {}};
  for (int i = 0; i < 3; ++i)
    frame.eye[i] = static_cast<float>(view.centre[i]);
  for (int i = 0; i < 9; ++i)
    frame.rotation[i] = static_cast<float>(view.rotation[i]);
  if (world.sun_static.heights != nullptr)
    frame.sun_static = seen_from(world.sun_static, view.centre);
  if (world.sun_moving.heights != nullptr)
    frame.sun_moving = seen_from(world.sun_moving, view.centre);
  return frame;
}

Vec towards(const Frame &frame, Floats x_px, Floats y_px) {
  const Floats a = (x_px - frame.cx) / frame.fx, b = (y_px - frame.cy) / frame.fy;
  const float *r = frame.rotation;
  const Vec ray = {r[0] * a + r[1] * b + r[2], r[3] * a + r[4] * b + r[5],
                   r[6] * a + r[7] * b + r[8]};
  return (1 / root(a * a + b * b + 1)) * ray;
}

// Bends the normal by the texture's slopes.
Vec bumped(const SurfaceLanes &surface, const Vec &normal, Floats slope_u, Floats slope_v) {
  const Vec &u = surface.along_u, &v = surface.along_v;
  const Floats u_scale = slope_u / root(dot(u, u) + 1e-12f),
               v_scale = slope_v / root(dot(v, v) + 1e-12f);
  const Vec bent = normal + u_scale * u + v_scale * v;
  return (1 / root(dot(bent, bent))) * bent;
}

Point point_on(const SurfaceLanes &surface, const Frame &frame, const Vec &ray) {
  Point point;
  const Floats signed_cosine = -dot(surface.normal, ray);
  const Floats above = dot(surface.normal, everywhere(frame.eye)) + surface.offset;
  const Floats divisor =
      magnitude(signed_cosine) > 1e-5f ? signed_cosine : all(1e-5f);
  point.distance_m = magnitude(above / divisor);
  const Floats side = signed_cosine < 0 ? all(-1.0f) : all(1.0f);
  point.flat_normal = side * surface.normal;
  point.cosine = larger(magnitude(signed_cosine), all(0.02f));
  point.from_eye = point.distance_m * ray;
  point.at = everywhere(frame.eye) + point.from_eye;
  point.to_eye = -1.0f * ray;
  point.flags = surface.flags;
  return point;
}

Floats reflected_light(const Frame &frame, const Point &point, const Texels &texels, Floats gloss) {
  const Ints glass = point.has(kGlass) & (texels.special > 0.02f), wet = point.wet > 0;
  if (!any(glass | wet))
    return Floats{};
  const Floats mirrored = reflected(frame, point), share = mirror(point.cosine);
  return where(glass, texels.special * (0.03f + share) * mirrored) +
         where(wet, point.wet * ((1 - frame.light.mirrors) * share * mirrored + gloss));
}

Floats shade_point(const Frame &frame, const SurfaceLanes &surface, Point &point,
                   const Texels &texels) {
  const Light &light = frame.light;
  Floats albedo = smaller(texels.albedo * surface.tint, all(0.95f));
  if (light.snow > 0) {
    const Floats snow = snow_cover(frame, point);
    albedo = mix(albedo, all(0.82f), snow);
    point.normal = point.normal + (0.7f * snow) * (point.flat_normal - point.normal);
  }
  point.wet = water_film(frame, point);
  if (light.wet > 0)
    albedo *= point.flat_normal.z > 0.5f ? all(1 - light.wet * 0.42f) : all(1 - light.wet * 0.15f);
  Shine shine = lamps_at(frame, point);
  if (light.headlights > 0)
    shine.diffuse += headlights_at(light, point);
  Floats luminance = albedo * (ambient(frame, point) + sunshine(frame, point) + shine.diffuse);
  const Ints glows = surface.glow > 0;
  if (light.windows > 0 && any(glows))
    luminance += where(glows, surface.glow * light.windows * texels.special *
                                  (0.15f + 1.2f * texels.albedo));
  luminance += reflected_light(frame, point, texels, shine.gloss);
  return fogged(light, luminance, point.distance_m);
}

Floats shade_surfaces(const Frame &frame, const Surface *const *surfaces, const Vec &ray) {
  const SurfaceLanes surface = gathered(surfaces);
  Point point = point_on(surface, frame, ray);
  const Vec slide = ray + point.cosine * point.flat_normal; // the ray's shadow on the surface
  const Vec along = (1 / root(dot(slide, slide) + 1e-12f)) * slide;
  const Floats u = dot(surface.along_u, point.at) + surface.u_at_origin;
  const Floats v = dot(surface.along_v, point.at) + surface.v_at_origin;
  point.across = u;
  const Texels texels = sample(frame.world.mips, surface, u, v, along,
                               point.distance_m * (1 / frame.fx), 1 / point.cosine);
  point.normal = bumped(surface, point.flat_normal, texels.slope_u, texels.slope_v);
  return shade_point(frame, surface, point, texels);
}

Floats shade_sky(const Frame &frame, const Vec &ray) {
  const Floats away = ray.z > 0.02f ? 25 / ray.z : all(1200.0f);
  return fogged(frame.light, sky(frame, ray), away);
}

void shade(const Frame &frame, Fragments &fragments, bool is_sky) {
  const size_t count = fragments.pixels.size();
  float nowhere = 0; // the last lanes without a fragment do as the last one with
  while (count > 0 && fragments.pixels.size() % kWide != 0) {
    fragments.surfaces.push_back(fragments.surfaces.back());
    fragments.x_px.push_back(fragments.x_px.back());
    fragments.y_px.push_back(fragments.y_px.back());
    fragments.weights.push_back(0);
    fragments.pixels.push_back(&nowhere);
  }
  for (size_t i = 0; i < count; i += kWide) {
    const Vec ray = towards(frame, load(&fragments.x_px[i]), load(&fragments.y_px[i]));
    const Floats luminance =
        is_sky ? shade_sky(frame, ray) : shade_surfaces(frame, &fragments.surfaces[i], ray);
    float parts[kWide];
    store(parts, smaller(luminance, all(kBrightest)) * load(&fragments.weights[i]));
    for (int lane = 0; lane < kWide; ++lane)
      *fragments.pixels[i + static_cast<size_t>(lane)] += parts[lane];
  }
  fragments.surfaces.clear();
  fragments.x_px.clear();
  fragments.y_px.clear();
  fragments.weights.clear();
  fragments.pixels.clear();
}

// Sorts the fragments of some rows of pixels.
class Sorter {
public:
  Sorter(const Mesh *meshes, const View &view, const int32_t *ids)
      : meshes_(meshes), ids_(ids), samples_(view.samples),
        stride_(static_cast<int64_t>(view.width) * view.samples) {}

  void add_pixel(Fragments *sorts, int32_t x, int32_t y, float *pixel) {
    const int32_t *corner =
        ids_ + static_cast<int64_t>(y) * samples_ * stride_ + static_cast<int64_t>(x) * samples_;
    int32_t seen[16];
    bool alike = true;
    for (int32_t j = 0; j < samples_; ++j)
      for (int32_t i = 0; i < samples_; ++i) {
        seen[j * samples_ + i] = corner[j * stride_ + i];
        alike = alike && seen[j * samples_ + i] == seen[0];
      }
    const float x_px = static_cast<float>(x), y_px = static_cast<float>(y);
    if (alike)
      add(sorts, seen[0], x_px, y_px, 1, pixel);
    else
      add_each(sorts, seen, x_px, y_px, pixel);
  }

private:
  // Each distinct surface at the middle of its samples.
  void add_each(Fragments *sorts, const int32_t *seen, float x, float y, float *pixel) {
    const int32_t count = samples_ * samples_;
    const float inside = static_cast<float>(samples_);
    uint32_t done = 0;
    for (int32_t k = 0; k < count; ++k) {
      if (done >> k & 1)
        continue;
      float x_sum = 0, y_sum = 0, weight = 0;
      for (int32_t m = k; m < count; ++m)
        if (seen[m] == seen[k]) {
          done |= 1u << m;
          x_sum += static_cast<float>(m % samples_);
          y_sum += static_cast<float>(m / samples_);
          weight += 1;
        }
      add(sorts, seen[k], x + (x_sum / weight + 0.5f) / inside - 0.5f,
          y + (y_sum / weight + 0.5f) / inside - 0.5f, weight / static_cast<float>(count), pixel);
    }
  }

  void add(Fragments *sorts, int32_t id, float x_px, float y_px, float weight, float *pixel) {
    if (id != last_id_) {
      last_id_ = id;
      surface_ = id < 0 ? nullptr
                        : meshes_[id >> kIndexBits].surfaces + (id & ((1 << kIndexBits) - 1));
      sort_ = id < 0 ? kSky : sort_of(*surface_);
    }
    Fragments &fragments = sorts[sort_];
    fragments.surfaces.push_back(surface_);
    fragments.x_px.push_back(x_px);
    fragments.y_px.push_back(y_px);
    fragments.weights.push_back(weight);
    fragments.pixels.push_back(pixel);
  }

  const Mesh *meshes_;
  const int32_t *ids_;
  int32_t samples_;
  int64_t stride_;
  int32_t last_id_ = -1;
  const Surface *surface_ = nullptr;
  Sort sort_ = kSky;
};

// The scalar twins of noise_at, water_film and mirror.
float noise_of(const int32_t *noise_quads, float x, float y) {
  const float x_floor = floorf(x), y_floor = floorf(y);
  const int32_t i = static_cast<int32_t>(x_floor) & 255, j = static_cast<int32_t>(y_floor) & 255;
  const auto quad = static_cast<uint32_t>(noise_quads[j * 256 + i]);
  const float a = x - x_floor, b = y - y_floor;
  const auto byte = [&](int k) { return static_cast<float>(quad >> (8 * k) & 255); };
  const float top = byte(0) + a * (byte(1) - byte(0)), bottom = byte(2) + a * (byte(3) - byte(2));
  return (top + b * (bottom - top)) * (1 / 255.0f);
}

float film_of(const Surroundings &world, const Light &light, float x, float y) {
  const float puddle = noise_of(world.noise_quads, 0.6f * x + 71, 0.6f * y + 13);
  const float t = std::clamp((puddle - 0.5f) / 0.12f, 0.0f, 1.0f);
  return light.wet * (0.25f + 0.75f * t * t * (3 - 2 * t));
}

float mirror_of(float cosine) {
  const float c = 1 - std::clamp(cosine, 0.0f, 1.0f), c2 = c * c;
  return 0.03f + 0.97f * c2 * c2 * c;
}

// Follows mirrored rays from the ground to what the picture shows there.
struct Mirror {
  const View &view;
  const float *inverse_depths, *shown;

  // The place of the picture, as an index, where a direction from a point (both in camera axes) ends:
  // a guess is corrected by the depth that stands there, which settles where fronts are upright.
  int64_t end_of(const float *from, const float *along) const {
    float far = 15;
    int64_t at = 0;
    for (int step = 0; step < 4; ++step) {
      float p[3];
      for (int k = 0; k < 3; ++k)
        p[k] = from[k] + far * along[k];
      const float z = std::max(p[2], 0.2f);
      const float u = std::clamp(view.cx + view.fx * p[0] / z, 0.0f, static_cast<float>(view.width - 1));
      const float v = std::clamp(view.cy + view.fy * p[1] / z, 0.0f, static_cast<float>(view.height - 1));
      at = static_cast<int64_t>(v + 0.5f) * view.width + static_cast<int64_t>(u + 0.5f);
      const float stands = inverse_depths[at];
      far = stands > 1e-3f ? (1 / stands - from[2]) / std::max(along[2], 0.05f) : 1000.0f;
      far = std::clamp(far, 0.2f, 1000.0f);
    }
    return at;
  }

  // Water that is never quite level draws a point out in height.
  float around(int64_t at) const {
    const int64_t above = at - 2 * view.width, below = at + 2 * view.width;
    const int64_t count = static_cast<int64_t>(view.width) * view.height;
    return 0.5f * shown[at] + 0.25f * (shown[above < 0 ? at : above] + shown[below < count ? below : at]);
  }
};

} // namespace

void mirror_view(const Surroundings &world, const Light &light, const View &view,
                 const float *inverse_depths, const float *shown, int32_t row_begin,
                 int32_t row_end, float *luminance) {
  constexpr double kLevel_m = 0.2; // ground and pavement
  const Mirror mirror = {view, inverse_depths, shown};
  const double *r = view.rotation;
  const float up[3] = {static_cast<float>(r[6]), static_cast<float>(r[7]),
                       static_cast<float>(r[8])}; // in camera axes
  for (int32_t y = row_begin; y < row_end; ++y)
    for (int32_t x = 0; x < view.width; ++x) {
      const int64_t i = static_cast<int64_t>(y) * view.width + x;
      if (inverse_depths[i] <= 0)
        continue;
      const float z = 1 / inverse_depths[i];
      const float from[3] = {(static_cast<float>(x) - view.cx) / view.fx * z,
                             (static_cast<float>(y) - view.cy) / view.fy * z, z};
      const float rise = up[0] * from[0] + up[1] * from[1] + up[2] * from[2];
      if (rise >= 0 || std::abs(view.centre[2] + rise) > kLevel_m)
        continue;
      const float away = sqrtf(from[0] * from[0] + from[1] * from[1] + z * z);
      float along[3], at[2];
      for (int k = 0; k < 3; ++k)
        along[k] = (from[k] - 2 * rise * up[k]) / away;
      for (int k = 0; k < 2; ++k)
        at[k] = static_cast<float>(view.centre[k] + r[3 * k] * from[0] + r[3 * k + 1] * from[1] +
                                   r[3 * k + 2] * from[2]);
      const float share = light.mirrors * mirror_of(-rise / away);
      const float through = expf(-light.fog_per_m * away);
      luminance[i] += share * through * film_of(world, light, at[0], at[1]) *
                      mirror.around(mirror.end_of(from, along));
    }
}

void shade_view(const Surroundings &world, const Light &light, const View &view, const int32_t *ids,
                int32_t row_begin, int32_t row_end, float *luminance) {
  constexpr int32_t kRows = 8; // enough fragments of each sort to fill the lanes, few for the cache
  const Frame frame = frame_of(world, light, view);
  Sorter sorter(world.meshes, view, ids);
  Fragments sorts[kSorts];
  for (int32_t first = row_begin; first < row_end; first += kRows) {
    for (int32_t y = first; y < first + kRows && y < row_end; ++y)
      for (int32_t x = 0; x < view.width; ++x) {
        float *pixel = luminance + static_cast<int64_t>(y) * view.width + x;
        *pixel = 0;
        sorter.add_pixel(sorts, x, y, pixel);
      }
    for (int sort = 0; sort < kSorts; ++sort)
      shade(frame, sorts[sort], sort == kSky);
  }
}

} // namespace engram::ENGRAM_ISA
