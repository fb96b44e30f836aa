// What the rasteriser and the shading read: plain records and pointers, owned by the binding.
//
// World axes: x east, y north, z up, metres. Camera axes: x right, y down, z forward. Pixel centres
// are at integers.
#pragma once

#include <cstdint>

namespace engram {

enum SurfaceFlag : uint32_t {
  kCutout = 1u << 0,      // the texture's fourth channel is coverage: foliage, railings
  kGlass = 1u << 1,       // the fourth channel says how much the surface mirrors
  kTranslucent = 1u << 2, // light passes through: leaves are bright from behind
  kTwoSided = 1u << 3, // seen from both sides; others only from where they turn counter-clockwise
  kNoShadow = 1u << 4, // throws no shadow
  kRoad = 1u << 5,     // ground that traffic drives on: wheel tracks in snow
  kCrossroad = 1u << 6, // ground where it crosses: snow is worn all over
  kSlender = 1u << 7,   // throws shadows, but hides next to nothing of the sky: posts, limbs
};

// One convex planar polygon of four vertices (a triangle repeats one). Texture coordinates are
// affine in the point: u = along_u · p + u_at_origin, in units of the texture's size.
struct Surface {
  float normal[3], offset; // normal · p + offset = 0
  float along_u[3], u_at_origin;
  float along_v[3], v_at_origin;
  float tint; // factor on the texture's albedo
  float glow; // emitted luminance where the fourth channel is 1
  int32_t texture;
  uint32_t flags;
};

struct Chunk { // surfaces that stand together
  float centre[3], radius;
  int32_t first, last;
};

constexpr int kMipLevels = 12;

// RGBA: albedo, slope along u, slope along v, coverage or mirror. Each level has a border of one
// texel on all sides that repeats the other end, so a row is widths[level] + 2 texels long.
struct Texture {
  const uint8_t *levels[kMipLevels]; // where the first texel within the border is
  int32_t widths[kMipLevels], heights[kMipLevels];
  int32_t level_count;
};

// The same by number: entry texture · kMipLevels + level.
struct Mips {
  const int64_t *texels;  // addresses as in Texture::levels
  const int32_t *sizes;   // width | height << 16
  const int32_t *counts;  // of levels, by texture
};

struct Mesh {
  const float *vertices; // (count, 4, 3)
  const Surface *surfaces;
  const Chunk *chunks;
  int32_t chunk_count;
};

// A surface's number in the visibility buffer: mesh and index; −1 is the sky.
constexpr int kIndexBits = 20;

// Where a picture is taken from: a pinhole (perspective), or a window of parallel rays.
struct View {
  double rotation[9]; // world_from_cam, row-major
  double centre[3];
  float fx, fy, cx, cy;
  int32_t width, height; // pixels
  int32_t samples;       // per pixel and axis
};

struct Window {    // parallel rays: column, row and height of a point are affine in it
  double axes[12]; // 3×4 row-major
  int32_t width, height;
};

struct Lamp {
  float position[3];
  float power;        // luminance × m² of a white surface
  float range;        // beyond which it is left out, metres
  const float *depth; // five faces (down, ±x, ±y) of 1/distance along the face's axis, or null
};

constexpr float kLampCell_m = 6;

struct LampGrid { // which lamps reach a square of the ground: lamps[starts[cell] … starts[cell +
                  // 1])
  const int32_t *starts, *lamps; // null without lamps
  float west_m, south_m;
  int32_t width, height; // cells
};

struct Light {
  float sun[3];    // towards the sun
  float sun_power; // irradiance / π on a surface facing the sun
  float sky_power; // mean luminance of the sky
  float cloud;     // share of the sky that clouds cover, 0…1
  float cloud_shift[2];
  float fog_per_m;  // extinction
  float haze;       // luminance of the air itself, as a factor of sky_power
  float wet, snow;  // 0…1
  float headlights; // 0…1
  float windows;    // factor on the glow of surfaces
  // Share of the sun's light that comes from the bright haze around it and from sunlit walls about:
  // it falls from the sun's side, so that relief shows in the shade too; shadows do not take it.
  float aureole;
  float mirrors; // 1: wet ground mirrors what the picture shows; 0: a front of one brightness
  float vehicle[9]; // left and right headlight, and the direction they shine
};

struct DepthMap { // a Window and what stands in it
  Window window;
  const float *heights; // towards the light; −1e9 where nothing is
};

struct Openness { // share of the sky that the ground sees
  const float *share;
  float west_m, south_m, cell_m;
  int32_t width, height;
};

struct Surroundings {
  const Mesh *meshes;
  Mips mips;
  DepthMap sun_static, sun_moving; // heights may be null
  Openness openness;
  const Lamp *lamps;
  LampGrid lamp_grid;
  const int32_t *noise_quads; // 256×256, tiles: the bytes at (i, j), (i + 1, j), … (i + 1, j + 1)
};

constexpr int kLampFace = 192; // texels across a face of a lamp's depth map

} // namespace engram
