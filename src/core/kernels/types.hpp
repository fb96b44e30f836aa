// What crosses the border between the bindings and the kernels: plain data, one type for every
// instruction set.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

namespace engram {

// target_from_source, rotation row-major.
struct RigidTransform {
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};
  std::array<double, 3> translation{0, 0, 0};
};

struct Camera {
  double fx, fy, cx, cy, baseline_m;
};

// Descriptors have at most so many 64-bit words: distances are counted in 16 bits.
constexpr int kMostWords = 256;

// The landmarks of a frame, as `engram.frontend.frame.Landmarks` has them.
struct FrameView {
  int64_t count;
  int width; // of a descriptor, 64-bit words
  const float *pixels;             // (count, 2)
  const float *disparity_px;       // (count,)
  const float *disparity_sigma_px; // (count,)
  const float *points_in_cam;      // (count, 3)
  const uint64_t *descriptors;     // (count, width)
  const uint8_t *octaves;          // (count,)
  Camera camera;
};

// See `engram.frontend.matching.MatcherConfig`, which holds the defaults and their reasons.
struct MatchSettings {
  int32_t max_distance = 0;
  int32_t max_guided_distance = 0;
  double ratio = 0;
  double guided_ratio = 0;
  double same_corner_px = 0;
  double octave_scale = 0;
  double patch_ratio = 0;
  double pixel_sigma_px = 0;
  double disparity_sigma_px = 0;
  double offset_sigma_px = 0;
  double offset_drift_px = 0;
  double gate_sigmas = 0;
  double max_radius_px = 0;
  double chi2 = 0;
  double independent_landmarks = 0;
  double few_inliers = 0;
  double displaced_m = 0;
  double offset_doubt = 0;
  double calibration_share = 0, calibration_m = 0, calibration_rad = 0;
  int32_t min_consensus = 0;
  int32_t max_samples = 0;
  int32_t max_hypotheses = 0;
  int32_t min_followers = 0;
  int32_t glance_share = 1;
  int32_t glance_samples = 0;
  int32_t glance_consensus = 0;
  int32_t glance_inliers = 0;
  double confidence = 0;
  double max_view_angle_cosine = -1;
  bool second_pass = true;
  bool same_camera = false;
};

struct RowPair {
  int32_t reference;
  int32_t live;
  int32_t distance;
};

struct PoseEstimate {
  bool found = false;
  RigidTransform reference_from_live;
  std::array<double, 36> covariance{}; // [translation, rotation], left perturbation
  std::array<double, 36> searched{};   // the same, as wide as a second pass searches
  std::vector<RowPair> inliers;
};

// A predicted reference_from_live and its covariance, row-major 6×6.
struct Prediction {
  RigidTransform reference_from_live;
  std::array<double, 36> covariance;
};

} // namespace engram
