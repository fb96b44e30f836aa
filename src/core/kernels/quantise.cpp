#include "kernels/quantise.hpp"

namespace engram::ENGRAM_ISA {
namespace {

// Half to even, as IEEE 754 rounds: above 2²³ floats are whole. For 0 ≤ x < 2²².
inline float rounded(float x) {
  constexpr float kWhole = 8388608;
  return (x + kWhole) - kWhole;
}

// The first code whose upper border is not below the value, without branches.
inline int code_of(float sigma_px, const Quanta &quanta) {
  const float *first = quanta.sigma_borders_px;
  int left = quanta.codes - 1;
  while (left > 1) {
    const int half = left / 2;
    first += first[half - 1] < sigma_px ? half : 0;
    left -= half;
  }
  return static_cast<int>(first - quanta.sigma_borders_px) + (*first < sigma_px);
}

} // namespace

bool quantise_landmarks(const QuantisedLandmarks &landmarks, const Quanta &quanta,
                        const Camera &camera) {
  constexpr float kMostSteps = 65535;
  const float step = quanta.step_px, steps = 1 / step;
  bool fits = true;
  for (int64_t i = 0; i < 2 * landmarks.count; ++i) {
    const float code = landmarks.pixels[i] * steps;
    fits &= code >= -0.5f && code < kMostSteps + 0.5f; // false for what is no number
    landmarks.pixels[i] = rounded(code > 0 ? code : 0) * step;
  }
  for (int64_t i = 0; i < landmarks.count; ++i) {
    const float code = landmarks.disparity_px[i] * steps;
    fits &= code < kMostSteps + 0.5f;
    landmarks.disparity_px[i] = rounded(code > 1 ? code : 1) * step;
  }
  if (!fits)
    return false;
  for (int64_t i = 0; i < landmarks.count; ++i)
    landmarks.sigma_px[i] = quanta.sigma_px[code_of(landmarks.sigma_px[i], quanta)];
  const double focal_baseline = camera.fx * camera.baseline_m;
  const auto cx = static_cast<float>(camera.cx), cy = static_cast<float>(camera.cy);
  const auto fx = static_cast<float>(camera.fx), fy = static_cast<float>(camera.fy);
  for (int64_t i = 0; i < landmarks.count; ++i) {
    const double depth = focal_baseline / static_cast<double>(landmarks.disparity_px[i]);
    float *point = landmarks.points_in_cam + 3 * i;
    point[0] = static_cast<float>(
        static_cast<double>((landmarks.pixels[2 * i] - cx) / fx) * depth);
    point[1] = static_cast<float>(
        static_cast<double>((landmarks.pixels[2 * i + 1] - cy) / fy) * depth);
    point[2] = static_cast<float>(depth);
  }
  return true;
}

} // namespace engram::ENGRAM_ISA
