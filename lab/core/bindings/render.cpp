// The renderer as Python sees it: a Scene that owns meshes, textures and the maps derived from
// them.
#include "kernels/mipmap.hpp"
#include "kernels/raster.hpp"
#include "kernels/sensor.hpp"
#include "kernels/shading.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>

#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>

#include "bindings/arrays.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace engram;

namespace {

using Image = nb::ndarray<const uint8_t, nb::shape<-1, -1, 4>, nb::c_contig, nb::device::cpu>;
using Plane = Input<float, 2>;

constexpr float kReach_m = 85;       // of the sun's map and the openness around its centre
constexpr float kStray_m = 25;       // how far the camera may leave that centre
constexpr float kSunTexel_m = 0.09f; // as coarse as the penumbra of the sun 10 m behind an edge
constexpr float kMovingTexel_m = 0.1f;
constexpr float kMovingReach_m = 35;
constexpr float kOpennessCell_m = 0.25f;
constexpr float kTallest_m = 24; // of what throws shadows into the map
constexpr float kFarthest_m = 600;
constexpr float kCell_m = 6; // surfaces within one are culled together
constexpr int kChunkMost = 96;
constexpr int kSlots = 1 << (31 - kIndexBits);
constexpr int kThreadsMost = 256;

// Runs task(0 … count − 1) on some threads, this one among them; throws what the first of them
// threw, once all have ended.
template <class Task> void parallel(int threads, int count, Task task) {
  threads = std::max(1, std::min(threads, count));
  std::vector<std::exception_ptr> failures(threads);
  const auto share = [&](int first) {
    try {
      for (int i = first; i < count; i += threads)
        task(i);
    } catch (...) {
      failures[first] = std::current_exception();
    }
  };
  std::vector<std::thread> others;
  others.reserve(threads - 1);
  int shared = 1;
  try {
    for (; shared < threads; ++shared)
      others.emplace_back(share, shared);
  } catch (const std::system_error &) { // no more threads are to be had: this one does the rest
  }
  share(0);
  for (; shared < threads; ++shared)
    share(shared);
  for (std::thread &other : others)
    other.join();
  for (const std::exception_ptr &failure : failures)
    if (failure)
      std::rethrow_exception(failure);
}

struct StoredMesh {
  bool stands = false; // else its number is free
  std::vector<float> vertices;
  std::vector<Surface> surfaces;
  std::vector<int32_t> objects;
  std::vector<Chunk> chunks;
};

struct StoredTexture {
  std::vector<uint8_t> bytes;
  Texture levels;       // none: its number is free
  int64_t surfaces = 0; // that it is on
};

struct StoredLamp {
  std::array<float, 3> position;
  float power, range;
  std::vector<float> depth; // empty until first needed
};

// What add_mesh is given, checked.
struct MeshArrays {
  Input<float, 3> vertices;   // (N, 4, 3)
  Input<float, 3> uv;         // (N, 4, 2)
  Input<int32_t, 1> textures; // (N,)
  Input<uint32_t, 1> flags;
  Input<float, 1> tint;
  Input<float, 1> glow;
  Input<int32_t, 1> objects;
};

bool all_finite(const float *values, size_t count) {
  return std::all_of(values, values + count, [](float value) { return std::isfinite(value); });
}

void check_mesh(const MeshArrays &in, const std::vector<StoredTexture> &textures) {
  const size_t count = in.vertices.shape(0);
  if (in.vertices.shape(1) != 4 || in.vertices.shape(2) != 3)
    throw nb::value_error("mesh: vertices must have shape (N, 4, 3)");
  if (in.uv.shape(0) != count || in.uv.shape(1) != 4 || in.uv.shape(2) != 2)
    throw nb::value_error("mesh: uv must have shape (N, 4, 2), N as in vertices");
  for (const size_t length : {in.textures.shape(0), in.flags.shape(0), in.tint.shape(0),
                              in.glow.shape(0), in.objects.shape(0)})
    if (length != count)
      throw nb::value_error("mesh: textures, flags, tint, glow and objects must have length N");
  if (count >= (size_t{1} << kIndexBits))
    throw nb::value_error("mesh: at most 1048575 surfaces");
  for (size_t i = 0; i < count; ++i) {
    const int32_t texture = in.textures.data()[i];
    if (texture < 0 || static_cast<size_t>(texture) >= textures.size() ||
        textures[texture].levels.level_count == 0)
      throw nb::value_error("mesh: a texture number is unknown");
  }
  if (!all_finite(in.vertices.data(), 12 * count))
    throw nb::value_error("mesh: a vertex is not finite");
  if (!all_finite(in.uv.data(), 8 * count) || !all_finite(in.tint.data(), count) ||
      !all_finite(in.glow.data(), count))
    throw nb::value_error("mesh: uv, tint and glow must be finite");
}

// Newell's normal: also right where two vertices coincide.
std::array<double, 3> normal_of(const float *v) {
  std::array<double, 3> n = {0, 0, 0};
  for (int i = 0; i < 4; ++i) {
    const float *p = v + 3 * i, *q = v + 3 * ((i + 1) & 3);
    for (int k = 0; k < 3; ++k)
      n[k] += (static_cast<double>(p[(k + 1) % 3]) - q[(k + 1) % 3]) *
              (static_cast<double>(p[(k + 2) % 3]) + q[(k + 2) % 3]);
  }
  const double length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
  for (double &value : n)
    value = length > 1e-12 ? value / length : 0;
  return n;
}

// Texture coordinates as an affine function of the point, from the corner with the widest angle.
void set_texture_axes(Surface &surface, const float *v, const float *uv) {
  double best = 0;
  for (int corner = 0; corner < 4; ++corner) {
    const int a = corner, b = (corner + 1) & 3, c = (corner + 3) & 3;
    double e1[3], e2[3], g11 = 0, g12 = 0, g22 = 0;
    for (int k = 0; k < 3; ++k) {
      e1[k] = static_cast<double>(v[3 * b + k]) - v[3 * a + k];
      e2[k] = static_cast<double>(v[3 * c + k]) - v[3 * a + k];
      g11 += e1[k] * e1[k], g12 += e1[k] * e2[k], g22 += e2[k] * e2[k];
    }
    const double determinant = g11 * g22 - g12 * g12;
    if (determinant <= best * 1.0001)
      continue;
    best = determinant;
    for (int axis = 0; axis < 2; ++axis) {
      const double d1 = static_cast<double>(uv[2 * b + axis]) - uv[2 * a + axis];
      const double d2 = static_cast<double>(uv[2 * c + axis]) - uv[2 * a + axis];
      const double s = (d1 * g22 - d2 * g12) / determinant, t = (d2 * g11 - d1 * g12) / determinant;
      float *along = axis == 0 ? surface.along_u : surface.along_v;
      double at = uv[2 * a + axis];
      for (int k = 0; k < 3; ++k) {
        const double value = s * e1[k] + t * e2[k];
        along[k] = static_cast<float>(value);
        at -= value * v[3 * a + k];
      }
      (axis == 0 ? surface.u_at_origin : surface.v_at_origin) = static_cast<float>(at);
    }
  }
}

Surface surface_of(const MeshArrays &in, size_t i) {
  Surface surface = {};
  const float *v = in.vertices.data() + 12 * i;
  const auto n = normal_of(v);
  for (int k = 0; k < 3; ++k)
    surface.normal[k] = static_cast<float>(n[k]);
  surface.offset = static_cast<float>(-(n[0] * v[0] + n[1] * v[1] + n[2] * v[2]));
  set_texture_axes(surface, v, in.uv.data() + 8 * i);
  surface.tint = in.tint.data()[i];
  surface.glow = in.glow.data()[i];
  surface.texture = in.textures.data()[i];
  surface.flags = in.flags.data()[i];
  return surface;
}

// Where surface i stands among the culling cells; large ones get a chunk of their own.
int64_t cell_of(const float *v, size_t i) {
  float low[3], high[3];
  for (int k = 0; k < 3; ++k) {
    low[k] = std::min({v[k], v[3 + k], v[6 + k], v[9 + k]});
    high[k] = std::max({v[k], v[3 + k], v[6 + k], v[9 + k]});
  }
  if (std::max(high[0] - low[0], high[1] - low[1]) > 2 * kCell_m)
    return std::numeric_limits<int64_t>::max() - static_cast<int64_t>(i);
  const auto column = static_cast<int64_t>(std::floor(0.5f * (low[0] + high[0]) / kCell_m));
  const auto row = static_cast<int64_t>(std::floor(0.5f * (low[1] + high[1]) / kCell_m));
  return (row + 100000) * 1000000 + column + 100000;
}

Chunk chunk_of(const std::vector<float> &vertices, int32_t first, int32_t last) {
  Chunk chunk = {};
  chunk.first = first, chunk.last = last;
  float radius2 = 0;
  for (int k = 0; k < 3; ++k) {
    float low = 1e30f, high = -1e30f;
    for (int64_t i = 4LL * first; i < 4LL * last; ++i) {
      low = std::min(low, vertices[3 * i + k]);
      high = std::max(high, vertices[3 * i + k]);
    }
    chunk.centre[k] = 0.5f * (low + high);
    radius2 += 0.25f * (high - low) * (high - low);
  }
  chunk.radius = std::sqrt(radius2) + 1e-3f;
  return chunk;
}

StoredMesh stored(const MeshArrays &in) {
  const size_t count = in.vertices.shape(0);
  std::vector<std::pair<int64_t, size_t>> order(count);
  for (size_t i = 0; i < count; ++i)
    order[i] = {cell_of(in.vertices.data() + 12 * i, i), i};
  std::sort(order.begin(), order.end());
  StoredMesh mesh;
  mesh.stands = true;
  mesh.vertices.reserve(12 * count);
  int32_t first = 0;
  for (size_t k = 0; k < count; ++k) {
    const size_t i = order[k].second;
    const float *v = in.vertices.data() + 12 * i;
    mesh.vertices.insert(mesh.vertices.end(), v, v + 12);
    mesh.surfaces.push_back(surface_of(in, i));
    mesh.objects.push_back(in.objects.data()[i]);
    const auto next = static_cast<int32_t>(k) + 1;
    if (k + 1 == count || order[k + 1].first != order[k].first || next - first >= kChunkMost) {
      mesh.chunks.push_back(chunk_of(mesh.vertices, first, next));
      first = next;
    }
  }
  return mesh;
}

struct RenderCamera {
  float fx, fy, cx, cy;
  int32_t width, height;
  float baseline_m;
  std::array<float, 3> turn; // of the right camera against the left one, small, radians
};

class Scene {
public:
  explicit Scene(const nb::ndarray<const uint8_t, nb::shape<256, 256>, nb::c_contig> &noise)
      : meshes_(1), noise_quads_(256 * 256) {
    const uint8_t *at = noise.data();
    for (int j = 0; j < 256; ++j)
      for (int i = 0; i < 256; ++i) {
        const int next = (i + 1) & 255, below = 256 * ((j + 1) & 255);
        noise_quads_[256 * j + i] = static_cast<int32_t>(
            at[256 * j + i] | at[256 * j + next] << 8 | at[below + i] << 16 |
            static_cast<uint32_t>(at[below + next]) << 24);
      }
  }

  int32_t add_texture(const Image &image, bool coverage);
  void remove_texture(int32_t texture);
  int32_t add_mesh(MeshArrays in);
  void remove_mesh(int32_t mesh);
  void set_moving(const MeshArrays &in) {
    check_mesh(in, textures_);
    put(0, stored(in));
  }
  void set_lamps(const Input<float, 2> &lamps);
  auto render(const RenderCamera &camera, const Input<double, 2> &rotation,
              const Input<double, 1> &centre, const Light &light, int threads);
  auto depth(const RenderCamera &camera, const Input<double, 2> &rotation,
             const Input<double, 1> &centre);
  size_t bytes() const;

private:
  void put(int32_t slot, StoredMesh mesh);
  View view_of(const RenderCamera &camera, const double *rotation, const double *centre, int eye,
               int samples) const;
  void point_at_meshes();
  std::vector<int32_t> order_from(const double *centre, double reach, int first_mesh,
                                  int last_mesh) const;
  void follow(const double *centre, const double *forward, const Light &light);
  void build_sun(const Light &light);
  void build_openness();
  void build_moving_sun(const Light &light, const double *centre);
  Window sun_window(const Light &light, const double *centre, float reach, float texel) const;
  std::vector<int32_t> in_window(const Window &window, int first_mesh, int last_mesh) const;
  std::vector<Lamp> lamps_near(const double *centre);
  void build_lamp(StoredLamp &lamp);
  LampGrid lamp_grid(const std::vector<Lamp> &lamps, const double *centre);

  std::vector<StoredMesh> meshes_; // the first holds what moves
  std::vector<int32_t> free_meshes_, free_textures_;
  std::vector<StoredTexture> textures_;
  std::vector<StoredLamp> lamps_;
  std::vector<int32_t> noise_quads_;
  std::vector<Mesh> mesh_table_;
  std::vector<Texture> texture_table_;
  std::vector<int64_t> mip_texels_;
  std::vector<int32_t> mip_sizes_, mip_counts_;
  std::vector<float> sun_, moving_sun_, openness_;
  std::vector<int32_t> lamp_starts_, lamp_items_;
  std::vector<int32_t> ids_;
  std::vector<float> depths_;
  DepthMap sun_map_ = {}, moving_map_ = {};
  Openness openness_map_ = {};
  double map_centre_[3] = {};
  float map_sun_[3] = {};
  bool maps_stand_ = false;
};

// Copies a level to where its border belongs around it: rows of width + 2 texels.
void put_with_border(const uint8_t *from, int32_t width, int32_t height, uint8_t *to) {
  const size_t row_bytes = 4ULL * width;
  for (int32_t y = -1; y <= height; ++y) {
    const uint8_t *row = from + row_bytes * static_cast<size_t>((y + height) % height);
    std::copy_n(row + row_bytes - 4, 4, to);
    std::copy_n(row, row_bytes, to + 4);
    std::copy_n(row, 4, to + 4 + row_bytes);
    to += row_bytes + 8;
  }
}

StoredTexture with_levels(const uint8_t *image, int32_t width, int32_t height, bool coverage) {
  StoredTexture texture = {};
  Texture &levels = texture.levels;
  std::array<size_t, kMipLevels> starts{};
  size_t total = 0;
  for (int32_t w = width, h = height; levels.level_count < kMipLevels;) {
    const int32_t k = levels.level_count++;
    starts[k] = total;
    levels.widths[k] = w, levels.heights[k] = h;
    total += 4ULL * (w + 2) * (h + 2);
    if (w == 1 && h == 1)
      break;
    w = std::max(1, w / 2), h = std::max(1, h / 2);
  }
  texture.bytes.resize(total);
  std::vector<uint8_t> finer, level(image, image + 4ULL * width * height);
  for (int32_t k = 0; k < levels.level_count; ++k) {
    const int32_t w = levels.widths[k], h = levels.heights[k];
    if (k > 0) {
      finer.swap(level);
      level.resize(4ULL * w * h);
      ENGRAM_CALL(halve_texture, finer.data(), levels.widths[k - 1], levels.heights[k - 1],
                  coverage, level.data());
    }
    put_with_border(level.data(), w, h, texture.bytes.data() + starts[k]);
    levels.levels[k] = texture.bytes.data() + starts[k] + 4ULL * (w + 3);
  }
  return texture;
}

int32_t Scene::add_texture(const Image &image, bool coverage) {
  const auto height = static_cast<int32_t>(image.shape(0)),
             width = static_cast<int32_t>(image.shape(1));
  if (height < 1 || width < 1 || height > 16384 || width > 16384)
    throw nb::value_error("texture: sides must be 1 to 16384 texels");
  StoredTexture texture;
  {
    nb::gil_scoped_release unlocked;
    texture = with_levels(image.data(), width, height, coverage);
  }
  if (free_textures_.empty()) {
    textures_.push_back(std::move(texture));
    return static_cast<int32_t>(textures_.size()) - 1;
  }
  const int32_t slot = free_textures_.back();
  free_textures_.pop_back();
  textures_[slot] = std::move(texture);
  return slot;
}

void Scene::remove_texture(int32_t texture) {
  if (texture < 0 || static_cast<size_t>(texture) >= textures_.size() ||
      textures_[texture].levels.level_count == 0)
    throw nb::value_error("scene: no such texture");
  if (textures_[texture].surfaces > 0)
    throw nb::value_error("scene: the texture is on a mesh; remove the mesh first");
  textures_[texture] = StoredTexture{};
  free_textures_.push_back(texture);
}

int32_t Scene::add_mesh(MeshArrays in) {
  check_mesh(in, textures_);
  if (free_meshes_.empty() && meshes_.size() >= kSlots)
    throw nb::value_error("scene: at most 2047 meshes at a time");
  StoredMesh mesh = stored(in);
  maps_stand_ = false;
  if (free_meshes_.empty()) {
    meshes_.emplace_back();
    free_meshes_.push_back(static_cast<int32_t>(meshes_.size()) - 1);
  }
  const int32_t slot = free_meshes_.back();
  free_meshes_.pop_back();
  put(slot, std::move(mesh));
  return slot;
}

void Scene::remove_mesh(int32_t mesh) {
  if (mesh < 1 || static_cast<size_t>(mesh) >= meshes_.size() || !meshes_[mesh].stands)
    throw nb::value_error("scene: no such mesh");
  put(mesh, {});
  free_meshes_.push_back(mesh);
  maps_stand_ = false;
}

// In place of what stood there; textures know how many surfaces they are on.
void Scene::put(int32_t slot, StoredMesh mesh) {
  for (const Surface &surface : meshes_[slot].surfaces)
    --textures_[surface.texture].surfaces;
  for (const Surface &surface : mesh.surfaces)
    ++textures_[surface.texture].surfaces;
  meshes_[slot] = std::move(mesh);
}

void Scene::set_lamps(const Input<float, 2> &lamps) {
  if (lamps.shape(1) != 5)
    throw nb::value_error("lamps must have shape (N, 5): x, y, z, power, range");
  if (!all_finite(lamps.data(), lamps.size()))
    throw nb::value_error("lamps must be finite");
  lamps_.clear();
  for (size_t i = 0; i < lamps.shape(0); ++i) {
    const float *row = lamps.data() + 5 * i;
    lamps_.push_back({{row[0], row[1], row[2]}, row[3], row[4], {}});
  }
}

View Scene::view_of(const RenderCamera &camera, const double *rotation, const double *centre, int eye,
                    int samples) const {
  View view = {};
  std::copy_n(rotation, 9, view.rotation);
  for (int k = 0; k < 3; ++k) {
    view.centre[k] = centre[k] + eye * camera.baseline_m * rotation[3 * k];
    const double *row = rotation + 3 * k;
    const double turn[3] = {eye * camera.turn[0], eye * camera.turn[1], eye * camera.turn[2]};
    for (int i = 0; i < 3; ++i)
      view.rotation[3 * k + i] +=
          row[(i + 1) % 3] * turn[(i + 2) % 3] - row[(i + 2) % 3] * turn[(i + 1) % 3];
  }
  view.fx = camera.fx, view.fy = camera.fy, view.cx = camera.cx, view.cy = camera.cy;
  view.width = camera.width, view.height = camera.height, view.samples = samples;
  return view;
}

void Scene::point_at_meshes() {
  mesh_table_.clear();
  for (const StoredMesh &mesh : meshes_)
    mesh_table_.push_back({mesh.vertices.data(), mesh.surfaces.data(), mesh.chunks.data(),
                           static_cast<int32_t>(mesh.chunks.size())});
  texture_table_.clear();
  mip_texels_.clear();
  mip_sizes_.clear();
  mip_counts_.clear();
  for (const StoredTexture &texture : textures_) {
    texture_table_.push_back(texture.levels);
    mip_counts_.push_back(texture.levels.level_count);
    for (int k = 0; k < kMipLevels; ++k) {
      mip_texels_.push_back(reinterpret_cast<int64_t>(texture.levels.levels[k]));
      mip_sizes_.push_back(texture.levels.widths[k] | texture.levels.heights[k] << 16);
    }
  }
}

// (mesh, chunk) pairs within reach, nearest first, so that what is hidden fails the depth test.
std::vector<int32_t> Scene::order_from(const double *centre, double reach, int first_mesh,
                                       int last_mesh) const {
  std::vector<std::tuple<float, int32_t, int32_t>> found;
  for (int m = first_mesh; m < last_mesh; ++m)
    for (size_t c = 0; c < meshes_[m].chunks.size(); ++c) {
      const Chunk &chunk = meshes_[m].chunks[c];
      double d2 = 0;
      for (int k = 0; k < 3; ++k)
        d2 += (chunk.centre[k] - centre[k]) * (chunk.centre[k] - centre[k]);
      const double nearest = std::sqrt(d2) - chunk.radius;
      if (nearest < reach)
        found.emplace_back(static_cast<float>(nearest), m, static_cast<int32_t>(c));
    }
  std::sort(found.begin(), found.end());
  std::vector<int32_t> order;
  for (const auto &[nearest, mesh, chunk] : found) {
    order.push_back(mesh);
    order.push_back(chunk);
  }
  return order;
}

Window Scene::sun_window(const Light &light, const double *centre, float reach, float texel) const {
  const double f[3] = {light.sun[0], light.sun[1], light.sun[2]};
  const double level = std::sqrt(f[0] * f[0] + f[1] * f[1]);
  const double r[3] = {level > 1e-6 ? -f[1] / level : 1, level > 1e-6 ? f[0] / level : 0, 0};
  const double u[3] = {f[1] * r[2] - f[2] * r[1], f[2] * r[0] - f[0] * r[2],
                       f[0] * r[1] - f[1] * r[0]};
  const double half_up = reach * std::abs(f[2]) + kTallest_m * level;
  Window window = {};
  window.width = static_cast<int32_t>(2 * reach / texel);
  window.height = static_cast<int32_t>(2 * half_up / texel);
  for (int k = 0; k < 3; ++k) {
    window.axes[k] = r[k] / texel;
    window.axes[4 + k] = u[k] / texel;
    window.axes[8 + k] = f[k];
    window.axes[3] -= r[k] * centre[k] / texel;
    window.axes[7] -= u[k] * centre[k] / texel;
    window.axes[11] -= f[k] * centre[k];
  }
  window.axes[3] += 0.5 * window.width;
  window.axes[7] += 0.5 * window.height;
  return window;
}

std::vector<int32_t> Scene::in_window(const Window &window, int first_mesh, int last_mesh) const {
  const double scale = std::sqrt(window.axes[0] * window.axes[0] + window.axes[1] * window.axes[1] +
                                 window.axes[2] * window.axes[2]);
  std::vector<int32_t> order;
  for (int m = first_mesh; m < last_mesh; ++m)
    for (size_t c = 0; c < meshes_[m].chunks.size(); ++c) {
      const Chunk &chunk = meshes_[m].chunks[c];
      double at[2];
      for (int k = 0; k < 2; ++k) {
        const double *axis = window.axes + 4 * k;
        at[k] = axis[0] * chunk.centre[0] + axis[1] * chunk.centre[1] + axis[2] * chunk.centre[2] +
                axis[3];
      }
      const double radius = chunk.radius * scale;
      if (at[0] < -radius || at[1] < -radius || at[0] > window.width + radius ||
          at[1] > window.height + radius)
        continue;
      order.push_back(m);
      order.push_back(static_cast<int32_t>(c));
    }
  return order;
}

void Scene::build_sun(const Light &light) {
  const Window window = sun_window(light, map_centre_, kReach_m, kSunTexel_m);
  sun_.resize(static_cast<size_t>(window.width) * window.height);
  const auto order = in_window(window, 1, static_cast<int>(meshes_.size()));
  ENGRAM_CALL(raster_window, mesh_table_.data(), texture_table_.data(), order.data(),
              static_cast<int32_t>(order.size() / 2), window, kNoShadow, sun_.data());
  sun_map_ = {window, sun_.data()};
}

void Scene::build_moving_sun(const Light &light, const double *centre) {
  const Window window = sun_window(light, centre, kMovingReach_m, kMovingTexel_m);
  const auto order = in_window(window, 0, 1);
  moving_map_ = {window, nullptr};
  if (order.empty())
    return;
  moving_sun_.resize(static_cast<size_t>(window.width) * window.height);
  ENGRAM_CALL(raster_window, mesh_table_.data(), texture_table_.data(), order.data(),
              static_cast<int32_t>(order.size() / 2), window, kNoShadow, moving_sun_.data());
  moving_map_.heights = moving_sun_.data();
}

void Scene::build_openness() {
  Window window = {};
  window.width = window.height = static_cast<int32_t>(2 * kReach_m / kOpennessCell_m);
  openness_map_ = {nullptr,
                   static_cast<float>(map_centre_[0]) - kReach_m,
                   static_cast<float>(map_centre_[1]) - kReach_m,
                   kOpennessCell_m,
                   window.width,
                   window.height};
  window.axes[0] = window.axes[5] = 1 / kOpennessCell_m;
  window.axes[10] = 1;
  window.axes[3] = -openness_map_.west_m / kOpennessCell_m;
  window.axes[7] = -openness_map_.south_m / kOpennessCell_m;
  std::vector<float> heights(static_cast<size_t>(window.width) * window.height);
  openness_.resize(heights.size());
  const auto order = in_window(window, 1, static_cast<int>(meshes_.size()));
  ENGRAM_CALL(raster_window, mesh_table_.data(), texture_table_.data(), order.data(),
              static_cast<int32_t>(order.size() / 2), window, kNoShadow | kCutout | kSlender,
              heights.data());
  ENGRAM_CALL(openness_of, heights.data(), window.width, window.height, kOpennessCell_m,
              openness_.data());
  openness_map_.share = openness_.data();
}

// The maps follow the camera; they are drawn again when it has left their middle, when the sun has
// moved, or when meshes have come or gone.
void Scene::follow(const double *centre, const double *forward, const Light &light) {
  const double ahead[3] = {centre[0] + 30 * forward[0], centre[1] + 30 * forward[1], 0};
  const double dx = ahead[0] - map_centre_[0], dy = ahead[1] - map_centre_[1];
  const bool strayed = !maps_stand_ || dx * dx + dy * dy > kStray_m * kStray_m;
  const bool turned = !std::equal(light.sun, light.sun + 3, map_sun_);
  if (strayed) {
    // On a grid, so that the same place has the same maps whatever was rendered before.
    for (int k = 0; k < 2; ++k)
      map_centre_[k] = 20 * std::round(ahead[k] / 20);
    if (!maps_stand_)
      for (StoredLamp &lamp : lamps_)
        lamp.depth.clear();
    build_openness();
  }
  if (light.sun_power > 0 && (strayed || turned || sun_map_.heights == nullptr))
    build_sun(light);
  if (light.sun_power <= 0)
    sun_map_.heights = nullptr;
  std::copy_n(light.sun, 3, map_sun_);
  maps_stand_ = true;
  moving_map_.heights = nullptr;
  if (light.sun_power > 0 && !meshes_[0].surfaces.empty())
    build_moving_sun(light, centre);
}

void Scene::build_lamp(StoredLamp &lamp) {
  // world_from_face columns right, down, forward: below, east, west, north, south.
  static constexpr double kFaces[5][9] = {{1, 0, 0, 0, -1, 0, 0, 0, -1},
                                          {0, 0, 1, -1, 0, 0, 0, -1, 0},
                                          {0, 0, -1, 1, 0, 0, 0, -1, 0},
                                          {1, 0, 0, 0, 0, 1, 0, -1, 0},
                                          {-1, 0, 0, 0, 0, -1, 0, -1, 0}};
  const RenderCamera square = {0.5f * kLampFace,
                         0.5f * kLampFace,
                         0.5f * kLampFace - 0.5f,
                         0.5f * kLampFace - 0.5f,
                         kLampFace,
                         kLampFace,
                         0,
                         {}};
  const double centre[3] = {lamp.position[0], lamp.position[1], lamp.position[2]};
  const auto order = order_from(centre, lamp.range, 1, static_cast<int>(meshes_.size()));
  lamp.depth.resize(5ULL * kLampFace * kLampFace);
  for (int face = 0; face < 5; ++face) {
    const View view = view_of(square, kFaces[face], centre, 0, 1);
    ENGRAM_CALL(raster_view, mesh_table_.data(), texture_table_.data(), order.data(),
                static_cast<int32_t>(order.size() / 2), view, 0, kLampFace, nullptr,
                lamp.depth.data() + static_cast<size_t>(face) * kLampFace * kLampFace);
  }
}

std::vector<Lamp> Scene::lamps_near(const double *centre) {
  std::vector<Lamp> near;
  for (StoredLamp &lamp : lamps_) {
    const double dx = lamp.position[0] - centre[0], dy = lamp.position[1] - centre[1];
    const double distance2 = dx * dx + dy * dy;
    if (lamp.power <= 0 || distance2 > 90 * 90) {
      lamp.depth.clear();
      lamp.depth.shrink_to_fit();
      continue;
    }
    if (lamp.depth.empty() && distance2 < 60 * 60)
      build_lamp(lamp);
    near.push_back({{lamp.position[0], lamp.position[1], lamp.position[2]},
                    lamp.power,
                    lamp.range,
                    distance2 < 60 * 60 ? lamp.depth.data() : nullptr});
  }
  return near;
}

// Which lamps reach which square of the ground around the camera.
LampGrid Scene::lamp_grid(const std::vector<Lamp> &lamps, const double *centre) {
  constexpr int kSide = 36;
  LampGrid grid = {};
  if (lamps.empty())
    return grid;
  grid.width = grid.height = kSide;
  grid.west_m = static_cast<float>(centre[0]) - kSide / 2 * kLampCell_m;
  grid.south_m = static_cast<float>(centre[1]) - kSide / 2 * kLampCell_m;
  lamp_starts_.clear();
  lamp_items_.clear();
  for (int cell = 0; cell < kSide * kSide; ++cell) {
    lamp_starts_.push_back(static_cast<int32_t>(lamp_items_.size()));
    const float x = grid.west_m + (static_cast<float>(cell % kSide) + 0.5f) * kLampCell_m;
    const float y = grid.south_m + (static_cast<float>(cell / kSide) + 0.5f) * kLampCell_m;
    for (size_t k = 0; k < lamps.size(); ++k) {
      const float dx = lamps[k].position[0] - x, dy = lamps[k].position[1] - y;
      const float reach = lamps[k].range + 0.71f * kLampCell_m;
      if (dx * dx + dy * dy < reach * reach)
        lamp_items_.push_back(static_cast<int32_t>(k));
    }
  }
  lamp_starts_.push_back(static_cast<int32_t>(lamp_items_.size()));
  grid.starts = lamp_starts_.data();
  grid.lamps = lamp_items_.data();
  return grid;
}

auto Scene::render(const RenderCamera &camera, const Input<double, 2> &rotation,
                   const Input<double, 1> &centre, const Light &light, int threads) {
  const size_t pixels = static_cast<size_t>(camera.width) * camera.height;
  constexpr int kSamples = 2;
  std::vector<float> luminance(2 * pixels), inverse_depth(2 * pixels);
  {
    nb::gil_scoped_release unlocked;
    point_at_meshes();
    const double *r = rotation.data(), forward[3] = {r[2], r[5], r[8]};
    follow(centre.data(), forward, light);
    const std::vector<Lamp> lamps = lamps_near(centre.data());
    const Surroundings world = {mesh_table_.data(),
                                {mip_texels_.data(), mip_sizes_.data(), mip_counts_.data()},
                                sun_map_,
                                moving_map_,
                                openness_map_,
                                lamps.data(),
                                lamp_grid(lamps, centre.data()),
                                noise_quads_.data()};
    const auto order = order_from(centre.data(), kFarthest_m, 0, static_cast<int>(meshes_.size()));
    const size_t samples = pixels * kSamples * kSamples;
    ids_.resize(2 * samples);
    depths_.resize(2 * samples);
    const int bands = threads > 1 ? 2 * threads : 1;
    parallel(threads, 2 * bands, [&](int task) {
      const int eye = task % 2, band = task / 2;
      const View view = view_of(camera, r, centre.data(), eye, kSamples);
      const int first = camera.height * band / bands, last = camera.height * (band + 1) / bands;
      int32_t *ids = ids_.data() + eye * samples;
      float *depths = depths_.data() + eye * samples;
      ENGRAM_CALL(raster_view, mesh_table_.data(), texture_table_.data(), order.data(),
                  static_cast<int32_t>(order.size() / 2), view, first * kSamples, last * kSamples,
                  ids, depths);
      ENGRAM_CALL(shade_view, world, light, view, ids, first, last,
                  luminance.data() + eye * pixels);
      for (int y = first; y < last; ++y)
        for (int x = 0; x < camera.width; ++x)
          inverse_depth[eye * pixels + static_cast<size_t>(y) * camera.width + x] =
              depths[(static_cast<size_t>(y) * camera.width * kSamples + x) * kSamples];
    });
    if (light.wet > 0 && light.mirrors > 0) {
      const std::vector<float> shown = luminance;
      parallel(threads, 2 * bands, [&](int task) {
        const int eye = task % 2, band = task / 2;
        const View view = view_of(camera, r, centre.data(), eye, kSamples);
        ENGRAM_CALL(mirror_view, world, light, view, inverse_depth.data() + eye * pixels,
                    shown.data() + eye * pixels, camera.height * band / bands,
                    camera.height * (band + 1) / bands, luminance.data() + eye * pixels);
      });
    }
  }
  const std::initializer_list<size_t> shape = {2, static_cast<size_t>(camera.height),
                                               static_cast<size_t>(camera.width)};
  return std::make_pair(to_numpy(std::move(luminance), shape),
                        to_numpy(std::move(inverse_depth), shape));
}

auto Scene::depth(const RenderCamera &camera, const Input<double, 2> &rotation,
                  const Input<double, 1> &centre) {
  const size_t pixels = static_cast<size_t>(camera.width) * camera.height;
  std::vector<int32_t> ids(pixels);
  std::vector<float> depths(pixels);
  {
    nb::gil_scoped_release unlocked;
    point_at_meshes();
    const auto order = order_from(centre.data(), kFarthest_m, 0, static_cast<int>(meshes_.size()));
    const View view = view_of(camera, rotation.data(), centre.data(), 0, 1);
    ENGRAM_CALL(raster_view, mesh_table_.data(), texture_table_.data(), order.data(),
                static_cast<int32_t>(order.size() / 2), view, 0, camera.height, ids.data(),
                depths.data());
    for (size_t i = 0; i < pixels; ++i) {
      depths[i] = ids[i] < 0 ? std::numeric_limits<float>::infinity() : 1 / depths[i];
      if (ids[i] >= 0)
        ids[i] = meshes_[ids[i] >> kIndexBits].objects[ids[i] & ((1 << kIndexBits) - 1)];
    }
  }
  const std::initializer_list<size_t> shape = {static_cast<size_t>(camera.height),
                                               static_cast<size_t>(camera.width)};
  return std::make_pair(to_numpy(std::move(depths), shape), to_numpy(std::move(ids), shape));
}

size_t Scene::bytes() const {
  size_t total =
      4 * (sun_.size() + moving_sun_.size() + openness_.size() + ids_.size() + depths_.size());
  for (const StoredTexture &texture : textures_)
    total += texture.bytes.size();
  for (const StoredMesh &mesh : meshes_)
    total += mesh.surfaces.size() * (sizeof(Surface) + 52);
  for (const StoredLamp &lamp : lamps_)
    total += 4 * lamp.depth.size();
  return total;
}

void check_pose(const RenderCamera &camera, const Input<double, 2> &rotation,
                const Input<double, 1> &centre) {
  if (rotation.shape(0) != 3 || rotation.shape(1) != 3 || centre.shape(0) != 3)
    throw nb::value_error("pose: rotation must have shape (3, 3) and position (3,)");
  for (int i = 0; i < 9; ++i)
    if (!std::isfinite(rotation.data()[i]) || !std::isfinite(centre.data()[i % 3]))
      throw nb::value_error("pose: must be finite");
  if (!(camera.fx > 0 && camera.fy > 0) || camera.width < 1 || camera.height < 1 ||
      camera.width > 4096 || camera.height > 4096)
    throw nb::value_error("camera: focal lengths must be > 0 and sides 1 to 4096 px");
  const float values[] = {camera.fx,         camera.fy,      camera.cx,      camera.cy,
                          camera.baseline_m, camera.turn[0], camera.turn[1], camera.turn[2]};
  if (!all_finite(values, std::size(values)))
    throw nb::value_error("camera: must be finite");
}

Light make_light(const Input<float, 1> &sun, const Input<float, 2> &vehicle, float sun_power,
                 float sky_power, float cloud, float cloud_x, float cloud_y, float fog_per_m,
                 float haze, float wet, float snow, float headlights, float windows,
                 float aureole, float mirrors) {
  if (sun.shape(0) != 3 || vehicle.shape(0) != 3 || vehicle.shape(1) != 3)
    throw nb::value_error("light: sun must have shape (3,) and vehicle (3, 3)");
  const float values[] = {sun_power, sky_power, cloud, cloud_x, cloud_y,    fog_per_m,
                          haze,      wet,       snow,  headlights, windows,
                          aureole,   mirrors};
  if (!all_finite(values, std::size(values)) || !all_finite(sun.data(), 3) ||
      !all_finite(vehicle.data(), 9))
    throw nb::value_error("light: must be finite");
  Light light = {};
  std::copy_n(sun.data(), 3, light.sun);
  std::copy_n(vehicle.data(), 9, light.vehicle);
  light.sun_power = sun_power, light.sky_power = sky_power, light.cloud = cloud;
  light.cloud_shift[0] = cloud_x, light.cloud_shift[1] = cloud_y;
  light.fog_per_m = fog_per_m, light.haze = haze, light.wet = wet, light.snow = snow;
  light.headlights = headlights, light.windows = windows, light.aureole = aureole;
  light.mirrors = mirrors;
  return light;
}

auto develop(const Plane &luminance, float gain, float shot, float read, float vignette,
             uint64_t seed) {
  const size_t height = luminance.shape(0), width = luminance.shape(1);
  std::vector<uint8_t> grey(width * height);
  {
    nb::gil_scoped_release unlocked;
    const Sensor sensor = {gain, shot, read, vignette, seed};
    ENGRAM_CALL(develop, luminance.data(), static_cast<int32_t>(width),
                static_cast<int32_t>(height), sensor, grey.data());
  }
  return to_numpy(std::move(grey), {height, width});
}

auto smear(const Plane &luminance, const Plane &inverse_depths, float fx, float fy, float cx,
           float cy, const Input<float, 1> &twist) {
  const size_t height = luminance.shape(0), width = luminance.shape(1);
  if (inverse_depths.shape(0) != height || inverse_depths.shape(1) != width || twist.shape(0) != 6)
    throw nb::value_error("smear: inverse_depths must match luminance and twist have length 6");
  std::vector<float> smeared(width * height);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(smear, luminance.data(), inverse_depths.data(), static_cast<int32_t>(width),
                static_cast<int32_t>(height), fx, fy, cx, cy, twist.data(), smeared.data());
  }
  return to_numpy(std::move(smeared), {height, width});
}

} // namespace

NB_MODULE(_town, module) {
  nb::set_leak_warnings(false);
  module.doc() = "The renderer of the simulated town. Every function releases the GIL.";
  nb::class_<Light>(module, "Light")
      .def_static("of", &make_light, "sun"_a, "vehicle"_a, "sun_power"_a, "sky_power"_a, "cloud"_a,
                  "cloud_x"_a, "cloud_y"_a, "fog_per_m"_a, "haze"_a, "wet"_a, "snow"_a,
                  "headlights"_a, "windows"_a, "aureole"_a, "mirrors"_a = 0.0f);
  nb::class_<RenderCamera>(module, "RenderCamera")
      .def(
          "__init__",
          [](RenderCamera *self, float fx, float fy, float cx, float cy, int32_t width, int32_t height,
             float baseline_m, const std::array<float, 3> &turn) {
            new (self) RenderCamera{fx, fy, cx, cy, width, height, baseline_m, turn};
          },
          "fx"_a, "fy"_a, "cx"_a, "cy"_a, "width"_a, "height"_a, "baseline_m"_a,
          "turn"_a = std::array<float, 3>{});
  nb::class_<Scene>(module, "Scene")
      .def(nb::init<const nb::ndarray<const uint8_t, nb::shape<256, 256>, nb::c_contig> &>(),
           "noise"_a)
      .def("add_texture", &Scene::add_texture, "texels"_a, "coverage"_a = false)
      .def("remove_texture", &Scene::remove_texture, "texture"_a)
      .def(
          "add_mesh",
          [](Scene &scene, Input<float, 3> vertices, Input<float, 3> uv, Input<int32_t, 1> textures,
             Input<uint32_t, 1> flags, Input<float, 1> tint, Input<float, 1> glow,
             Input<int32_t, 1> objects) {
            return scene.add_mesh({vertices, uv, textures, flags, tint, glow, objects});
          },
          "vertices"_a, "uv"_a, "textures"_a, "flags"_a, "tint"_a, "glow"_a, "objects"_a)
      .def("remove_mesh", &Scene::remove_mesh, "mesh"_a)
      .def(
          "set_moving",
          [](Scene &scene, Input<float, 3> vertices, Input<float, 3> uv, Input<int32_t, 1> textures,
             Input<uint32_t, 1> flags, Input<float, 1> tint, Input<float, 1> glow,
             Input<int32_t, 1> objects) {
            scene.set_moving({vertices, uv, textures, flags, tint, glow, objects});
          },
          "vertices"_a, "uv"_a, "textures"_a, "flags"_a, "tint"_a, "glow"_a, "objects"_a)
      .def("set_lamps", &Scene::set_lamps, "lamps"_a)
      .def(
          "render",
          [](Scene &scene, const RenderCamera &camera, Input<double, 2> rotation,
             Input<double, 1> position, const Light &light, int threads) {
            check_pose(camera, rotation, position);
            if (threads < 1 || threads > kThreadsMost)
              throw nb::value_error("render: threads must be 1 to 256");
            return scene.render(camera, rotation, position, light, threads);
          },
          "camera"_a, "rotation"_a, "position"_a, "light"_a, "threads"_a = 1)
      .def(
          "depth",
          [](Scene &scene, const RenderCamera &camera, Input<double, 2> rotation,
             Input<double, 1> position) {
            check_pose(camera, rotation, position);
            return scene.depth(camera, rotation, position);
          },
          "camera"_a, "rotation"_a, "position"_a)
      .def_prop_ro("bytes", &Scene::bytes);
  module.def("develop", &develop, "luminance"_a, "gain"_a, "shot"_a, "read"_a, "vignette"_a,
             "seed"_a);
  module.def("smear", &smear, "luminance"_a, "inverse_depths"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a,
             "twist"_a);
}
