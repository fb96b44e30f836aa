#include "kernels/raster.hpp"

#include <math.h>

#include <vector>

#include "kernels/pixel_lanes.hpp"

namespace engram::ENGRAM_ISA {
namespace {

using namespace wide;

constexpr double kNear = 0.1; // metres

// Everything is linear in the sample's column x and row y: f = dx·x + dy·y + at.
struct Linear {
  double dx, dy, at;
};

// An edge crosses row y at column slope · y + at, and what lies beyond it is outside.
struct Bound {
  enum Side { kLeft, kRight, kLevel } side;
  double slope, at;
};

struct Target {
  int32_t width, row_begin, row_end;
  int32_t *ids;
  float *values;
};

// A polygon ready to fill: its edges, the value that the greatest of wins, and where a cutout's
// texture coordinates are.
struct Polygon {
  Linear edges[4];
  Bound bounds[4]; // what the edges say of a row
  Linear value;
  double x_min, x_max, y_min, y_max;
  Linear u, v;       // of texture coordinates, times value when perspective
  double u_at, v_at; // added after the division by value
  bool perspective;
  const uint8_t *mask; // RGBA level, null for solid surfaces
  int32_t mask_width, mask_height;
};

inline double dot(const float *a, const double *b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// The edge from p to q as a plane through the origin: positive on the side of the polygon.
inline Linear edge_between(const double *p, const double *q, double side, const Linear &x,
                           const Linear &y) {
  const double a = side * (p[1] * q[2] - p[2] * q[1]), b = side * (p[2] * q[0] - p[0] * q[2]),
               c = side * (p[0] * q[1] - p[1] * q[0]);
  return {a * x.dx, b * y.dy, a * x.at + b * y.at + c};
}

inline Linear plane(const double *normal, double scale, const Linear &x, const Linear &y) {
  return {scale * normal[0] * x.dx, scale * normal[1] * y.dy,
          scale * (normal[0] * x.at + normal[1] * y.at + normal[2])};
}

inline void fill_solid(int32_t *ids, float *values, int32_t from, int32_t to, float at, float step,
                       int32_t id) {
  for (int32_t x = from; x <= to; ++x) {
    const float value = at + step * static_cast<float>(x);
    const bool wins = value > values[x];
    values[x] = wins ? value : values[x];
    ids[x] = wins ? id : ids[x];
  }
}

inline void fill_depth(float *values, int32_t from, int32_t to, float at, float step) {
  for (int32_t x = from; x <= to; ++x) {
    const float value = at + step * static_cast<float>(x);
    values[x] = value > values[x] ? value : values[x];
  }
}

typedef double Doubles __attribute__((vector_size(8 * kWide)));

// The part of 0…1 that a number stands at.
inline Doubles fraction(Doubles x) {
  const Doubles whole = __builtin_convertvector(__builtin_convertvector(x, Ints), Doubles);
  const Doubles part = x - whole;
  return part < 0 ? part + 1 : part;
}

inline Ints texel_at(Doubles place, int32_t size) {
  const Ints texel = __builtin_convertvector(fraction(place) * size, Ints);
  return texel & (texel >= 0) & (texel < size); // lanes outside the polygon may hold anything
}

// Where the texture of a cutout covers the samples of some columns.
inline Ints covered(const Polygon &polygon, Doubles columns, double u_row, double v_row,
                    Floats value) {
  const Doubles one = Doubles{} + 1.0;
  const Doubles scale =
      polygon.perspective ? one / __builtin_convertvector(value, Doubles) : one;
  const Doubles u = (u_row + polygon.u.dx * columns) * scale + polygon.u_at;
  const Doubles v = (v_row + polygon.v.dx * columns) * scale + polygon.v_at;
  const Ints column = texel_at(u, polygon.mask_width), row = texel_at(v, polygon.mask_height);
  const Ints texels = gather(reinterpret_cast<const int32_t *>(polygon.mask),
                             row * (polygon.mask_width + 2) + column);
  return texels < 0; // the fourth channel, the word's highest byte, is 128 or more
}

inline Floats load_some(const float *values, int32_t count) {
  Floats lanes = {};
  __builtin_memcpy(&lanes, values, 4 * static_cast<size_t>(count));
  return lanes;
}

inline void fill_cutout(const Polygon &polygon, const Target &target, int64_t row, int32_t from,
                        int32_t to, float at, float step, int32_t y, int32_t id) {
  const double u_row = polygon.u.dy * y + polygon.u.at, v_row = polygon.v.dy * y + polygon.v.at;
  Ints lanes;
  for (int lane = 0; lane < kWide; ++lane)
    lanes[lane] = lane;
  for (int32_t first = from; first <= to; first += kWide) {
    float *values = target.values + row + first;
    const Ints columns = first + lanes;
    const Floats value = at + step * to_floats(columns);
    const bool whole = first + kWide <= target.width;
    const Floats before = whole ? load(values) : load_some(values, target.width - first);
    Ints wins = (value > before) & (columns <= to);
    if (!any(wins))
      continue;
    wins &= covered(polygon, __builtin_convertvector(columns, Doubles), u_row, v_row, value);
    float won[kWide];
    store(won, value);
    for (uint32_t left = bits_of(wins); left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      values[lane] = won[lane];
      if (target.ids != nullptr)
        target.ids[row + first + lane] = id;
    }
  }
}

Bound bound_of(const Linear &edge) {
  if (edge.dx > 1e-12)
    return {Bound::kLeft, -edge.dy / edge.dx, -edge.at / edge.dx};
  if (edge.dx < -1e-12)
    return {Bound::kRight, -edge.dy / edge.dx, -edge.at / edge.dx};
  return {Bound::kLevel, edge.dy, edge.at};
}

// The interval of columns of row y that lies inside all edges.
inline bool interval(const Polygon &polygon, int32_t y, double &low, double &high) {
  low = polygon.x_min;
  high = polygon.x_max;
  for (const Bound &bound : polygon.bounds) {
    const double x = bound.slope * y + bound.at;
    if (bound.side == Bound::kLeft)
      low = x > low ? x : low;
    else if (bound.side == Bound::kRight)
      high = x < high ? x : high;
    else if (x < 0)
      return false;
  }
  return low <= high;
}

void fill(Polygon &polygon, const Target &target, int32_t id) {
  for (int i = 0; i < 4; ++i)
    polygon.bounds[i] = bound_of(polygon.edges[i]);
  const int32_t first = static_cast<int32_t>(
      ceil(polygon.y_min > target.row_begin ? polygon.y_min : target.row_begin));
  const double last_row = target.row_end - 1;
  const int32_t last =
      static_cast<int32_t>(floor(polygon.y_max < last_row ? polygon.y_max : last_row));
  for (int32_t y = first; y <= last; ++y) {
    double low, high;
    if (!interval(polygon, y, low, high))
      continue;
    const int32_t from = static_cast<int32_t>(ceil(low)), to = static_cast<int32_t>(floor(high));
    const float at = static_cast<float>(polygon.value.dy * y + polygon.value.at);
    const float step = static_cast<float>(polygon.value.dx);
    const int64_t row = static_cast<int64_t>(y) * target.width;
    int32_t *ids = target.ids == nullptr ? nullptr : target.ids + row;
    if (polygon.mask != nullptr)
      fill_cutout(polygon, target, row, from, to, at, step, y, id);
    else if (ids != nullptr)
      fill_solid(ids, target.values + row, from, to, at, step, id);
    else
      fill_depth(target.values + row, from, to, at, step);
  }
}

void grow(Polygon &polygon, double x, double y) {
  polygon.x_min = x < polygon.x_min ? x : polygon.x_min;
  polygon.x_max = x > polygon.x_max ? x : polygon.x_max;
  polygon.y_min = y < polygon.y_min ? y : polygon.y_min;
  polygon.y_max = y > polygon.y_max ? y : polygon.y_max;
}

void clamp_box(Polygon &polygon, int32_t width) {
  polygon.x_min = polygon.x_min > 0 ? polygon.x_min : 0;
  polygon.x_max = polygon.x_max < width - 1 ? polygon.x_max : width - 1;
}

void take_mask(Polygon &polygon, const Texture &texture, double texels_per_sample) {
  int32_t level = 0;
  while (texels_per_sample > 1.5 && level + 3 < texture.level_count) {
    texels_per_sample *= 0.5;
    ++level;
  }
  polygon.mask = texture.levels[level];
  polygon.mask_width = texture.widths[level];
  polygon.mask_height = texture.heights[level];
}

// Columns and rows of samples as linear functions: x_cam / z_cam = x.dx · column + x.at.
struct Grid {
  Linear x, y;
};

Grid grid_of(const View &view) {
  const double step = 1.0 / view.samples, first = 0.5 * step - 0.5;
  return {{step / view.fx, 0, (first - view.cx) / view.fx},
          {0, step / view.fy, (first - view.cy) / view.fy}};
}

// The box of samples that the polygon can touch; false when it lies wholly behind the near plane.
bool bound(Polygon &polygon, const double points[4][3], const Grid &grid) {
  polygon.x_min = polygon.y_min = 1e9;
  polygon.x_max = polygon.y_max = -1e9;
  for (int i = 0; i < 4; ++i) {
    const double *p = points[i], *q = points[(i + 1) & 3];
    if (p[2] >= kNear)
      grow(polygon, (p[0] / p[2] - grid.x.at) / grid.x.dx, (p[1] / p[2] - grid.y.at) / grid.y.dy);
    if ((p[2] < kNear) == (q[2] < kNear))
      continue;
    const double s = (kNear - p[2]) / (q[2] - p[2]);
    grow(polygon, ((p[0] + s * (q[0] - p[0])) / kNear - grid.x.at) / grid.x.dx,
         ((p[1] + s * (q[1] - p[1])) / kNear - grid.y.at) / grid.y.dy);
  }
  return polygon.x_min <= polygon.x_max;
}

// Rows of cam_from_world times a world vector.
inline void turn(const double *rotation, const double *vector, double *turned) {
  for (int i = 0; i < 3; ++i)
    turned[i] = rotation[i] * vector[0] + rotation[3 + i] * vector[1] + rotation[6 + i] * vector[2];
}

void mask_in_view(Polygon &polygon, const Surface &surface, const Texture &texture,
                  const View &view, const Grid &grid, double depth) {
  const double along_u[3] = {surface.along_u[0], surface.along_u[1], surface.along_u[2]};
  const double along_v[3] = {surface.along_v[0], surface.along_v[1], surface.along_v[2]};
  double u_cam[3], v_cam[3];
  turn(view.rotation, along_u, u_cam);
  turn(view.rotation, along_v, v_cam);
  polygon.u = plane(u_cam, 1.0, grid.x, grid.y);
  polygon.v = plane(v_cam, 1.0, grid.x, grid.y);
  polygon.u_at = dot(surface.along_u, view.centre) + surface.u_at_origin;
  polygon.v_at = dot(surface.along_v, view.centre) + surface.v_at_origin;
  polygon.perspective = true;
  const double per_m = texture.widths[0] * sqrt(along_u[0] * along_u[0] + along_u[1] * along_u[1] +
                                                along_u[2] * along_u[2]);
  take_mask(polygon, texture, per_m * depth * grid.x.dx);
}

bool set_up_in_view(Polygon &polygon, const float *vertices, const Surface &surface,
                    const Texture *textures, const View &view, const Grid &grid, int32_t columns,
                    double row_low, double row_high) {
  double points[4][3];
  for (int i = 0; i < 4; ++i) {
    const double from_centre[3] = {vertices[3 * i] - view.centre[0],
                                   vertices[3 * i + 1] - view.centre[1],
                                   vertices[3 * i + 2] - view.centre[2]};
    turn(view.rotation, from_centre, points[i]);
  }
  const double world_normal[3] = {surface.normal[0], surface.normal[1], surface.normal[2]};
  double normal[3];
  turn(view.rotation, world_normal, normal);
  const double distance =
      normal[0] * points[0][0] + normal[1] * points[0][1] + normal[2] * points[0][2];
  const bool from_behind = distance > 0;
  if ((from_behind && !(surface.flags & kTwoSided)) || fabs(distance) < 1e-6)
    return false;
  if (!bound(polygon, points, grid))
    return false;
  if (polygon.x_max < 0 || polygon.x_min > columns - 1 || polygon.y_max < row_low ||
      polygon.y_min > row_high || ceil(polygon.y_min) > polygon.y_max)
    return false;
  clamp_box(polygon, columns);
  for (int i = 0; i < 4; ++i)
    polygon.edges[i] =
        edge_between(points[i], points[(i + 1) & 3], from_behind ? 1.0 : -1.0, grid.x, grid.y);
  polygon.value = plane(normal, 1.0 / distance, grid.x, grid.y);
  polygon.mask = nullptr;
  if (surface.flags & kCutout)
    mask_in_view(polygon, surface, textures[surface.texture], view, grid,
                 0.5 * (points[0][2] + points[2][2]));
  return true;
}

// What lies behind all that a square of samples shows already needs not be drawn. The squares'
// least values are taken anew after 32, 64, 128 … chunks; between those they are a little out of
// date, which is safe: values only grow.
class Covered {
public:
  explicit Covered(const Target &target)
      : target_(target), across_((target.width + kSide - 1) / kSide),
        down_((target.row_end - target.row_begin + kSide - 1) / kSide),
        least_(static_cast<size_t>(across_) * static_cast<size_t>(down_), 0.0f) {}

  void look() {
    for (int32_t j = 0; j < down_; ++j)
      for (int32_t i = 0; i < across_; ++i)
        least_[static_cast<size_t>(j * across_ + i)] = least_in(i * kSide, j * kSide);
  }

  // Whether nothing in a box of samples can show a value up to `most`.
  bool hides(double x_min, double x_max, double y_min, double y_max, double most) const {
    const int32_t i0 = square(x_min, across_), i1 = square(x_max, across_);
    const int32_t j0 = square(y_min - target_.row_begin, down_),
                  j1 = square(y_max - target_.row_begin, down_);
    for (int32_t j = j0; j <= j1; ++j)
      for (int32_t i = i0; i <= i1; ++i)
        if (static_cast<double>(least_[static_cast<size_t>(j * across_ + i)]) < most)
          return false;
    return true;
  }

private:
  static constexpr int32_t kSide = 32;

  static int32_t square(double sample, int32_t count) {
    const double at = sample < 0 ? 0 : sample / kSide;
    return at < count - 1 ? static_cast<int32_t>(at) : count - 1;
  }

  float least_in(int32_t column, int32_t row) const {
    const int32_t last_row = row + kSide < target_.row_end - target_.row_begin
                                 ? row + kSide
                                 : target_.row_end - target_.row_begin;
    const int32_t last_column =
        column + kSide < target_.width ? column + kSide : target_.width;
    float least = 1e9f;
    for (int32_t y = row; y < last_row; ++y) {
      const float *values =
          target_.values + static_cast<int64_t>(y + target_.row_begin) * target_.width;
      for (int32_t x = column; x < last_column; ++x)
        least = values[x] < least ? values[x] : least;
    }
    return least;
  }

  Target target_;
  int32_t across_, down_;
  std::vector<float> least_;
};

// The most that a value computed in floats exceeds its exact one by, as a factor.
constexpr double kRounding = 1.001;

bool hidden(const Chunk &chunk, const View &view, const Grid &grid, const Covered &covered) {
  const double from_centre[3] = {chunk.centre[0] - view.centre[0], chunk.centre[1] - view.centre[1],
                                 chunk.centre[2] - view.centre[2]};
  double c[3];
  turn(view.rotation, from_centre, c);
  const double r = chunk.radius, nearest = c[2] - r, farthest = c[2] + r;
  if (nearest < 1)
    return false;
  const double left = (c[0] - r) / (c[0] > r ? farthest : nearest),
               right = (c[0] + r) / (c[0] > -r ? nearest : farthest),
               top = (c[1] - r) / (c[1] > r ? farthest : nearest),
               bottom = (c[1] + r) / (c[1] > -r ? nearest : farthest);
  return covered.hides((left - grid.x.at) / grid.x.dx, (right - grid.x.at) / grid.x.dx,
                       (top - grid.y.at) / grid.y.dy, (bottom - grid.y.at) / grid.y.dy,
                       kRounding / nearest);
}

// Whether a sphere can be seen: against the near plane and the four sides of the picture.
bool in_view(const Chunk &chunk, const View &view) {
  const double from_centre[3] = {chunk.centre[0] - view.centre[0], chunk.centre[1] - view.centre[1],
                                 chunk.centre[2] - view.centre[2]};
  double c[3];
  turn(view.rotation, from_centre, c);
  const double r = chunk.radius;
  if (c[2] < kNear - r)
    return false;
  const double left = (-0.5 - view.cx) / view.fx, right = (view.width - 0.5 - view.cx) / view.fx;
  const double top = (-0.5 - view.cy) / view.fy, bottom = (view.height - 0.5 - view.cy) / view.fy;
  return c[0] - left * c[2] > -r * sqrt(1 + left * left) &&
         right * c[2] - c[0] > -r * sqrt(1 + right * right) &&
         c[1] - top * c[2] > -r * sqrt(1 + top * top) &&
         bottom * c[2] - c[1] > -r * sqrt(1 + bottom * bottom);
}

bool set_up_in_window(Polygon &polygon, const float *vertices, const Surface &surface,
                      const Texture *textures, const Window &window) {
  const double *axes = window.axes;
  double points[4][3];
  polygon.x_min = polygon.y_min = 1e9;
  polygon.x_max = polygon.y_max = -1e9;
  for (int i = 0; i < 4; ++i) {
    for (int k = 0; k < 2; ++k)
      points[i][k] = dot(vertices + 3 * i, axes + 4 * k) + axes[4 * k + 3];
    points[i][2] = 1.0;
    grow(polygon, points[i][0], points[i][1]);
  }
  if (polygon.x_max < 0 || polygon.y_max < 0 || polygon.x_min > window.width - 1 ||
      polygon.y_min > window.height - 1)
    return false;
  // The normal in the window's coordinates: rows of axes are orthogonal, of lengths k, k, 1.
  const double k2 = axes[0] * axes[0] + axes[1] * axes[1] + axes[2] * axes[2];
  const double across = dot(surface.normal, axes) / k2, down = dot(surface.normal, axes + 4) / k2,
               up = dot(surface.normal, axes + 8);
  if (fabs(up) < 1e-4)
    return false; // seen edge on
  const double height = dot(vertices, axes + 8) + axes[11];
  polygon.value = {-across / up, -down / up,
                   height + (across * points[0][0] + down * points[0][1]) / up};
  const Linear column = {1, 0, 0}, row = {0, 1, 0};
  for (int i = 0; i < 4; ++i)
    polygon.edges[i] =
        edge_between(points[i], points[(i + 1) & 3], up > 0 ? 1.0 : -1.0, column, row);
  clamp_box(polygon, window.width);
  polygon.mask = nullptr;
  if (!(surface.flags & kCutout))
    return true;
  polygon.perspective = false;
  polygon.u_at = polygon.v_at = 0;
  const double height_u = dot(surface.along_u, axes + 8), height_v = dot(surface.along_v, axes + 8);
  polygon.u = {dot(surface.along_u, axes) / k2 + height_u * polygon.value.dx,
               dot(surface.along_u, axes + 4) / k2 + height_u * polygon.value.dy, 0};
  polygon.v = {dot(surface.along_v, axes) / k2 + height_v * polygon.value.dx,
               dot(surface.along_v, axes + 4) / k2 + height_v * polygon.value.dy, 0};
  const double corner[3] = {vertices[0], vertices[1], vertices[2]};
  polygon.u.at = dot(surface.along_u, corner) + surface.u_at_origin - polygon.u.dx * points[0][0] -
                 polygon.u.dy * points[0][1];
  polygon.v.at = dot(surface.along_v, corner) + surface.v_at_origin - polygon.v.dx * points[0][0] -
                 polygon.v.dy * points[0][1];
  take_mask(polygon, textures[surface.texture],
            fabs(polygon.u.dx) * textures[surface.texture].widths[0]);
  return true;
}

} // namespace

void raster_view(const Mesh *meshes, const Texture *textures, const int32_t *order,
                 int32_t order_count, const View &view, int32_t row_begin, int32_t row_end,
                 int32_t *ids, float *inverse_depths) {
  const int32_t columns = view.width * view.samples;
  const Target target = {columns, row_begin, row_end, ids, inverse_depths};
  for (int64_t i = static_cast<int64_t>(row_begin) * columns;
       i < static_cast<int64_t>(row_end) * columns; ++i)
    inverse_depths[i] = 0;
  if (ids != nullptr)
    for (int64_t i = static_cast<int64_t>(row_begin) * columns;
         i < static_cast<int64_t>(row_end) * columns; ++i)
      ids[i] = -1;
  const Grid grid = grid_of(view);
  Covered covered(target);
  int32_t drawn = 0;
  for (int32_t k = 0; k < order_count; ++k) {
    const int32_t slot = order[2 * k];
    const Mesh &mesh = meshes[slot];
    const Chunk &chunk = mesh.chunks[order[2 * k + 1]];
    if (!in_view(chunk, view) || (drawn >= 32 && hidden(chunk, view, grid, covered)))
      continue;
    if (++drawn >= 32 && (drawn & (drawn - 1)) == 0)
      covered.look();
    for (int32_t i = chunk.first; i < chunk.last; ++i) {
      Polygon polygon;
      if (set_up_in_view(polygon, mesh.vertices + 12 * static_cast<int64_t>(i), mesh.surfaces[i],
                         textures, view, grid, columns, row_begin, row_end - 1))
        fill(polygon, target, (slot << kIndexBits) | i);
    }
  }
}

void raster_window(const Mesh *meshes, const Texture *textures, const int32_t *order,
                   int32_t order_count, const Window &window, uint32_t skip_flags, float *heights) {
  const Target target = {window.width, 0, window.height, nullptr, heights};
  for (int64_t i = 0; i < static_cast<int64_t>(window.width) * window.height; ++i)
    heights[i] = -1e9f;
  for (int32_t k = 0; k < order_count; ++k) {
    const Mesh &mesh = meshes[order[2 * k]];
    const Chunk &chunk = mesh.chunks[order[2 * k + 1]];
    for (int32_t i = chunk.first; i < chunk.last; ++i) {
      Polygon polygon;
      if (!(mesh.surfaces[i].flags & skip_flags) &&
          set_up_in_window(polygon, mesh.vertices + 12 * static_cast<int64_t>(i), mesh.surfaces[i],
                           textures, window))
        fill(polygon, target, 0);
    }
  }
}

void openness_of(const float *heights, int32_t width, int32_t height, float cell_m, float *share) {
  // Many directions and small steps: with few, the share jumps where a house ends.
  constexpr int kDirections = 16, kRings = 8;
  constexpr float kAcross[kDirections] = {1,  0.9239f,  0.7071f,  0.3827f,  0, -0.3827f, -0.7071f,
                                          -0.9239f, -1, -0.9239f, -0.7071f, -0.3827f, 0, 0.3827f,
                                          0.7071f,  0.9239f};
  constexpr float kRadius_m[kRings] = {0.4f, 0.9f, 1.8f, 3.6f, 5.0f, 7.0f, 9.6f, 13.0f};
  std::vector<float> row_buffer(2 * static_cast<size_t>(width));
  float *steepest = row_buffer.data(), *open = steepest + width;
  for (int32_t y = 0; y < height; ++y) {
    const float *own = heights + static_cast<int64_t>(y) * width;
    for (int32_t x = 0; x < width; ++x)
      open[x] = 0;
    for (int k = 0; k < kDirections; ++k) {
      // Under something: only what light comes in from the side.
      for (int32_t x = 0; x < width; ++x)
        steepest[x] = own[x] > 0.4f ? own[x] / 1.2f : 0;
      for (int ring = 0; ring < kRings; ++ring) {
        const auto i = static_cast<int32_t>(kRadius_m[ring] * kAcross[k] / cell_m);
        const auto j =
            static_cast<int32_t>(kRadius_m[ring] * kAcross[(k + 12) % kDirections] / cell_m);
        if (y + j < 0 || y + j >= height)
          break;
        const float *there = own + static_cast<int64_t>(j) * width + i;
        const int32_t first = i < 0 ? -i : 0, last = i > 0 ? width - i : width;
        const float per_m = 1 / kRadius_m[ring];
        for (int32_t x = first; x < last; ++x) {
          const float slope = (there[x] - 0.15f) * per_m;
          steepest[x] = slope > steepest[x] ? slope : steepest[x];
        }
      }
      for (int32_t x = 0; x < width; ++x) // the sky above that horizon, cosine-weighted
        open[x] += 1.0f / (1.0f + steepest[x] * steepest[x]);
    }
    for (int32_t x = 0; x < width; ++x)
      share[static_cast<int64_t>(y) * width + x] = open[x] * (1.0f / kDirections);
  }
}

} // namespace engram::ENGRAM_ISA
