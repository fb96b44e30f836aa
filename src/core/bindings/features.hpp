// The landmarks of a frame as they come from Python.
#pragma once

#include <array>

#include "bindings/arrays.hpp"

namespace engram {

inline constexpr size_t kMostLandmarks = 32767; // rows are counted in 16 bits

// Holds on to a frame's arrays; checked once, so that the kernels need not.
struct Features {
  Input<float, 2> pixels;
  Input<float, 1> disparity_px, disparity_sigma_px;
  Input<float, 2> points_in_cam;
  Descriptors descriptors;
  Input<uint8_t, 1> octaves;
  std::array<double, 5> camera; // fx, fy, cx, cy, baseline_m

  Features(Input<float, 2> pixels, Input<float, 1> disparity_px,
           Input<float, 1> disparity_sigma_px, Input<float, 2> points_in_cam,
           Descriptors descriptors, Input<uint8_t, 1> octaves, std::array<double, 5> camera)
      : pixels(pixels), disparity_px(disparity_px), disparity_sigma_px(disparity_sigma_px),
        points_in_cam(points_in_cam), descriptors(descriptors), octaves(octaves), camera(camera) {
    const size_t count = pixels.shape(0);
    if (pixels.shape(1) != 2 || points_in_cam.shape(1) != 3)
      throw nanobind::value_error("pixels must have shape (N, 2) and points_in_cam (N, 3)");
    for (const size_t other : {disparity_px.shape(0), disparity_sigma_px.shape(0),
                               points_in_cam.shape(0), descriptors.shape(0), octaves.shape(0)})
      if (other != count)
        throw nanobind::value_error("the arrays of a frame's landmarks must have one row each");
    width_of(descriptors);
    if (count > kMostLandmarks)
      throw nanobind::value_error("a frame may have at most 32767 landmarks");
  }

  FrameView view() const {
    return {static_cast<int64_t>(pixels.shape(0)),
            width_of(descriptors),
            pixels.data(),
            disparity_px.data(),
            disparity_sigma_px.data(),
            points_in_cam.data(),
            words(descriptors),
            octaves.data(),
            {camera[0], camera[1], camera[2], camera[3], camera[4]}};
  }
};

} // namespace engram
