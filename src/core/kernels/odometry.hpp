// Visual odometry: frames in temporal order → the motion between them. All that it remembers of
// them, the window of keyframes with the tracks of their landmarks, is plain data here.
#pragma once

#include <optional>

#include "dispatch.hpp"
#include "kernels/types.hpp"

namespace engram {

// See engram.odometry.odometry.OdometryConfig and WindowConfig, which hold the defaults and their
// reasons.
struct OdometrySettings {
  MatchSettings match;
  int32_t window_frames = 0, window_landmarks = 0, window_iterations = 0;
  double window_offset_sigma_px = 0, window_pixel_sigma_px = 0, window_disparity_sigma_px = 0;
  int32_t min_inliers = 0, unexpected_inliers = 0, plausible_inliers = 0;
  double usual_share = 0, few_inliers = 0;
  double acceleration_m_s2 = 0, angular_acceleration_rad_s2 = 0;
  double max_prediction_s = 0;
  double steady_m = 0, steady_rad = 0, steady_share = 0;
  double braking_m_s2 = 0, braking_share = 0, disbelief_s = 0;
  double keyframe_flow_px = 0, keyframe_share = 0;
};

// A frame of the window. A copy, since the window outlives the caller's arrays.
struct KeptFrame {
  int width = 0;
  Camera camera{};
  std::vector<float> pixels, disparity_px, disparity_sigma_px, points_in_cam;
  std::vector<uint64_t> descriptors;
  std::vector<uint8_t> octaves;
  RigidTransform world_from_cam;
  std::vector<int32_t> tracks; // of each landmark; −1 if no other frame shares it
  std::vector<float> window_pixel_sigma_px, window_disparity_sigma_px; // in the window

  FrameView view() const {
    return {static_cast<int64_t>(octaves.size()), width,
            pixels.data(),        disparity_px.data(), disparity_sigma_px.data(),
            points_in_cam.data(), descriptors.data(),  octaves.data(),
            camera};
  }
};

// The window's poses are in the camera of its first frame. The next frame replaces the newest one
// unless that became a keyframe, so that the window spans motion, not time.
struct OdometryWindow {
  std::vector<KeptFrame> keyframes;
  std::optional<KeptFrame> newest; // none while the newest frame is a keyframe
  int32_t tracks = 0;              // numbered by birth, dense among those that live
  double offset_px = 0;            // what the camera's disparities are too large by
};

struct BelievedSpeed {
  std::array<double, 6> velocity; // tangent per second
  double step_m;
  int64_t stamp_ns; // of the frame in which its step ends
};

// An unbroken run of frames.
struct OdometryTrack {
  OdometryWindow window;
  int64_t stamp_ns = 0;
  RigidTransform keyframe_from_prev;
  std::array<double, 36> covariance{}; // of keyframe_from_prev
  std::array<double, 36> searched{};   // the same, as wide as matching searches
  std::optional<std::array<double, 6>> velocity; // tangent per second
  std::optional<BelievedSpeed> believed; // of the last step that was neither vague nor stopped
  bool stopped = false; // whether an impossible stop came since then
};

struct OdometryState {
  std::optional<OdometryTrack> track;
  // Of the last steps, oldest first: what is usual for this camera and light.
  std::vector<double> inliers, intervals_s;
};

struct OdometryMotion {
  enum class Status : int32_t { first, ok, too_few_matches, no_consensus };
  Status status = Status::first;
  RigidTransform prev_from_curr;
  std::array<double, 36> covariance{}; // of prev_from_curr, left perturbation
  int32_t inliers = 0;
};

// prev_from_curr by other sensors.
struct ExpectedMotion {
  RigidTransform prev_from_curr;
  std::array<double, 36> covariance;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // The motion since the last frame; the next one starts from `live`. All frames are of one
    // camera and one kind of descriptor.
    OdometryMotion odometry_step(OdometryState &state, const OdometrySettings &settings,
                                 const FrameView &live, int64_t stamp_ns,
                                 const ExpectedMotion *expected);)
