// The last few keyframes with the landmarks they share (Geiger et al. 2016 §III-A).
#pragma once

#include "kernels/odometry.hpp"

namespace engram::ENGRAM_ISA {

// A pose with its covariance, left perturbation.
struct PlacedPose {
  RigidTransform pose;
  std::array<double, 36> covariance;
  std::array<double, 36> searched; // the same, as wide as matching searches
};

// A window of the first frame of a run.
OdometryWindow begin_window(const FrameView &first, const OdometrySettings &settings,
                            double offset_px);

inline const KeptFrame &keyframe_of(const OdometryWindow &window) {
  return window.keyframes.back();
}

// Makes the frame the newest one, matched to the last keyframe.
void add_to_window(OdometryWindow &window, const FrameView &frame, const PoseEstimate &match,
                   const OdometrySettings &settings);

// Makes the newest frame a keyframe; the oldest one leaves when the window is full.
void keep_newest(OdometryWindow &window, const OdometrySettings &settings);

// keyframe_from_newest once all poses but the oldest, and all landmarks, are adjusted; as matched
// where the landmarks do not determine the window.
PlacedPose optimise_window(OdometryWindow &window, const PoseEstimate &match,
                           const OdometrySettings &settings);

} // namespace engram::ENGRAM_ISA
