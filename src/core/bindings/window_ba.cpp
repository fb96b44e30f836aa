#include "kernels/window_ba.hpp"

#include <nanobind/stl/array.h>

#include "bindings/transforms.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace engram;

namespace {

nb::object adjust_window(const std::array<double, 5> &camera,
                         const Input<double, 3> &world_from_cam, const Input<int32_t, 1> &frame,
                         const Input<int32_t, 1> &track, const Input<float, 2> &stereo,
                         const Input<float, 1> &pixel_sigma_px,
                         const Input<float, 1> &disparity_sigma_px, int32_t fixed,
                         int32_t iterations, double chi2, double offset_px,
                         double offset_sigma_px) {
  const size_t poses = world_from_cam.shape(0), count = frame.shape(0);
  if (world_from_cam.shape(1) != 4 || world_from_cam.shape(2) != 4)
    throw nb::value_error("world_from_cam must have shape (P, 4, 4)");
  if (stereo.shape(1) != 3)
    throw nb::value_error("stereo must have shape (K, 3)");
  for (const size_t other : {track.shape(0), stereo.shape(0), pixel_sigma_px.shape(0),
                             disparity_sigma_px.shape(0)})
    if (other != count)
      throw nb::value_error("the arrays of the observations must have one row each");
  if (!(offset_sigma_px > 0))
    throw nb::value_error("offset_sigma_px must be > 0");
  if (fixed < 0)
    throw nb::value_error("fixed must not be negative");
  int32_t tracks = 0;
  for (size_t k = 0; k < count; ++k) {
    if (frame.data()[k] < 0 || static_cast<size_t>(frame.data()[k]) >= poses)
      throw nb::index_error("an observation lies in a frame outside the window");
    // Tracks index arrays here, so they are to be numbered without large gaps.
    if (track.data()[k] < 0 || static_cast<size_t>(track.data()[k]) > 64 * count)
      throw nb::index_error("tracks must be numbered from 0 without large gaps");
    tracks = std::max(tracks, track.data()[k] + 1);
  }
  std::vector<RigidTransform> before;
  for (size_t p = 0; p < poses; ++p)
    before.push_back(rigid_from(world_from_cam.data() + 16 * p));
  const WindowObservations observations{static_cast<int64_t>(count),
                                        frame.data(),
                                        track.data(),
                                        stereo.data(),
                                        pixel_sigma_px.data(),
                                        disparity_sigma_px.data(),
                                        tracks};
  const Camera view{camera[0], camera[1], camera[2], camera[3], camera[4]};
  WindowResult result;
  {
    nb::gil_scoped_release unlocked;
    result = ENGRAM_CALL(adjust_window, view, before, observations,
                         WindowSettings{fixed, iterations, chi2, offset_px, offset_sigma_px});
  }
  if (!result.solved)
    return nb::none();
  std::vector<double> matrices;
  for (const RigidTransform &pose : result.world_from_cam)
    append_matrix(pose, matrices);
  const size_t free = 6 * (poses - fixed);
  return nb::make_tuple(to_numpy(std::move(matrices), {poses, 4, 4}),
                        to_numpy(std::move(result.covariance), {free, free}),
                        to_numpy(std::move(result.points), {static_cast<size_t>(tracks), 3}),
                        result.offset_px, result.cost_before, result.cost_after);
}

} // namespace

void bind_window_ba(nb::module_ &module) {
  module.def("adjust_window", &adjust_window, "camera"_a, "world_from_cam"_a, "frame"_a, "track"_a,
             "stereo"_a, "pixel_sigma_px"_a, "disparity_sigma_px"_a, "fixed"_a, "iterations"_a,
             "chi2"_a, "offset_px"_a, "offset_sigma_px"_a,
             "Optimises poses (P, 4, 4), landmarks and the offset of all disparities together: (world_from_cam (P, 4, 4), "
             "covariance of the free poses (6F, 6F), points (T, 3), offset px, cost before, cost after), or "
             "None where the observations do not determine the poses. A frame sees a track once.");
}
