// Joint optimisation of the poses of a short window of frames and of the landmarks they share.
#pragma once

#include "dispatch.hpp"
#include "kernels/types.hpp"

namespace engram {

struct WindowSettings {
  int32_t fixed;       // so many poses, the first ones, stay as they are
  int32_t iterations;  // at most
  double chi2;         // scale c² of the robust kernel, on χ² of one observation
  double offset_px;    // what all disparities are too large by, as far as known …
  double offset_sigma_px; // … and how well
};

// Observations in any order; `track` names the landmark.
struct WindowObservations {
  int64_t count;
  const int32_t *frame;            // 0 … poses − 1
  const int32_t *track;            // 0 … any bound below `tracks`
  const float *stereo;             // (count, 3): left u, left v, disparity, px
  const float *pixel_sigma_px;     // (count,)
  const float *disparity_sigma_px; // (count,)
  int32_t tracks;
};

struct WindowResult {
  bool solved = false;
  double cost_before = 0, cost_after = 0;
  double offset_px = 0;
  std::vector<RigidTransform> world_from_cam;
  std::vector<double> covariance; // of the free poses, left perturbations, 6 rows each
  std::vector<double> points;     // (tracks, 3), world; NaN for tracks seen only once
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    WindowResult adjust_window(const Camera &camera,
                               const std::vector<RigidTransform> &world_from_cam,
                               const WindowObservations &observations,
                               const WindowSettings &settings);)
