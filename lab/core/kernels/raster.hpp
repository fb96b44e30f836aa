// Which surface is seen where: a rasteriser for convex planar quads without clipping.
//
// A point of the picture is inside when it lies on the same side of all edges in homogeneous
// coordinates (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997);
// that needs no clipping at the near plane. The inside of a row is an interval, found from the
// edges directly, and is filled in one vectorised sweep.
#pragma once

#include "dispatch.hpp"
#include "kernels/scene.hpp"

ENGRAM_DECLARE_KERNELS(
    // Rows [row_begin, row_end) of samples: ids = surface seen, inverse_depths = 1/z, 0 for none.
    // Both have view.width · view.samples columns. ids may be null. order lists (mesh, chunk) pairs
    // front to back.
    void raster_view(const Mesh *meshes, const Texture *textures, const int32_t *order,
                     int32_t order_count, const View &view, int32_t row_begin, int32_t row_end,
                     int32_t *ids, float *inverse_depths);

    // heights (window.height, window.width): the greatest third coordinate seen along each ray.
    void raster_window(const Mesh *meshes, const Texture *textures, const int32_t *order,
                       int32_t order_count, const Window &window, uint32_t skip_flags,
                       float *heights);

    // The share of the sky that the ground sees, from heights above it on a grid of cell_m.
    void openness_of(const float *heights, int32_t width, int32_t height, float cell_m,
                     float *share);)
