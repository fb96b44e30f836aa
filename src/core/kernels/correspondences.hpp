// Matched landmarks as arrays of float lanes, and what a pose makes of them: residuals, scores,
// normal equations.
//
// The residual of a match is the stereo reprojection error in the live camera,
//     r = π(live_from_reference · X) − (u, v, disparity),
// with the covariance
//     C = diag(σ_p², σ_p², σ_d²) + σ_δ² j jᵀ.
// σ_p unites the pixel errors of both corners, brought to live pixels; σ_d is the live disparity's;
// σ_δ is the relative depth error of X along its ray and j = ∂π/∂δ carries it into the live camera
// (first order). So a far point of the reference, or one that the live camera sees from much
// closer, weighs as little as it knows. C⁻¹ is in closed form (Sherman–Morrison).
//
// What all disparities of a camera have in common, an offset β from its rectification, does not
// average out: it is estimated along with the pose (`Offsets`), held by a prior.
#pragma once

#include <vector>

#include "kernels/float_lanes.hpp"
#include "kernels/projection.hpp"
#include "kernels/rigid.hpp"

namespace engram::ENGRAM_ISA {

struct Correspondences {
  int64_t count = 0;
  int64_t padded = 0;
  Camera live;
  std::vector<float> x, y, z; // in the reference camera, metres
  std::vector<float> u, v, d; // in the live image, px
  std::vector<float> inverse_disparity; // of the reference, 1/px
  std::vector<float> pixel_information, disparity_information, depth_variance;
  std::vector<float> valid; // 1, and 0 in the padding

  explicit Correspondences(const Camera &live) : live(live) {}

  void reserve(size_t wanted) {
    for (auto *values : {&x, &y, &z, &u, &v, &d, &inverse_disparity, &pixel_information,
                         &disparity_information, &depth_variance, &valid})
      values->reserve(wanted + kLanes);
  }

  void add(const Vec3 &point, double reference_disparity, const Vec3 &stereo,
           double pixel_variance, double disparity_variance, double relative_depth_variance) {
    const auto f = [](double value) { return static_cast<float>(value); };
    x.push_back(f(point[0])), y.push_back(f(point[1])), z.push_back(f(point[2]));
    u.push_back(f(stereo[0])), v.push_back(f(stereo[1])), d.push_back(f(stereo[2]));
    inverse_disparity.push_back(f(1 / reference_disparity));
    pixel_information.push_back(f(1 / pixel_variance));
    disparity_information.push_back(f(1 / disparity_variance));
    depth_variance.push_back(f(relative_depth_variance));
    valid.push_back(1);
    ++count;
  }

  void add(const Correspondences &from, int64_t i) {
    x.push_back(from.x[i]), y.push_back(from.y[i]), z.push_back(from.z[i]);
    u.push_back(from.u[i]), v.push_back(from.v[i]), d.push_back(from.d[i]);
    inverse_disparity.push_back(from.inverse_disparity[i]);
    pixel_information.push_back(from.pixel_information[i]);
    disparity_information.push_back(from.disparity_information[i]);
    depth_variance.push_back(from.depth_variance[i]);
    valid.push_back(1);
    ++count;
  }

  // Fills the last block up with points behind the camera.
  void pad() {
    padded = (count + kLanes - 1) / kLanes * kLanes;
    for (auto *values : {&x, &y, &u, &v, &d, &inverse_disparity, &depth_variance, &valid})
      values->resize(padded, 0);
    for (auto *values : {&pixel_information, &disparity_information, &z})
      values->resize(padded, 1);
  }

  void clear() {
    for (auto *values : {&x, &y, &z, &u, &v, &d, &inverse_disparity, &pixel_information,
                         &disparity_information, &depth_variance, &valid})
      values->clear();
    count = padded = 0;
  }
};

// By how much the disparities of either camera are too large, px.
struct Offsets {
  double reference = 0;
  double live = 0;
};

// live_from_reference in floats, as the lanes want it.
struct FloatPose {
  float m[9];
  float t[3];
  float reference_offset = 0, live_offset = 0;

  FloatPose() = default;
  explicit FloatPose(const Pose &reference_from_live, const Offsets &offsets = {})
      : reference_offset(static_cast<float>(offsets.reference)),
        live_offset(static_cast<float>(offsets.live)) {
    const Pose live_from_reference = inverse(reference_from_live);
    for (int i = 0; i < 9; ++i)
      m[i] = static_cast<float>(live_from_reference.rotation[i]);
    for (int i = 0; i < 3; ++i)
      t[i] = static_cast<float>(live_from_reference.translation[i]);
  }
};

// Everything about sixteen matches, or about four, that the score and the normal equations share.
template <int lanes> struct Block {
  typedef Pack<float, lanes> Floats;
  typedef Pack<int32_t, lanes> Ints;

  Floats x, y, z;                                  // in the reference, its offset taken off
  Floats by_offset;                                // relative depth by the reference's offset
  Floats along_u, along_v, u_by_z, v_by_z, d_by_z; // non-zero entries of ∂π/∂(live point)
  Floats ru, rv, rd;                               // residual
  Floats ju, jv, jd;                               // by relative depth
  Floats wp, wd;                                   // information of pixel and disparity
  Floats kappa, hr;                                // rank-one part of C⁻¹, and its dot with r
  Floats depth_information;                        // jᵀ D⁻¹ j
  Floats kept;                                     // the share of it that C⁻¹ leaves
  Floats chi2;                                     // rᵀ C⁻¹ r
  Ints usable;                                     // −1 where in front and valid, else 0

  Block(const Correspondences &matches, int64_t i, const FloatPose &pose) {
    const auto load = [](const float *values) { return Floats::load(values); };
    const float *m = pose.m, *t = pose.t;
    const Floats inverse_disparity = load(&matches.inverse_disparity[i]);
    const Floats stretch = 1.0f / (1.0f - pose.reference_offset * inverse_disparity);
    by_offset = inverse_disparity * stretch;
    x = load(&matches.x[i]) * stretch;
    y = load(&matches.y[i]) * stretch;
    z = load(&matches.z[i]) * stretch;
    const Floats rx = m[0] * x + m[1] * y + m[2] * z, ry = m[3] * x + m[4] * y + m[5] * z,
                 rz = m[6] * x + m[7] * y + m[8] * z;
    const Floats depth = rz + t[2];
    usable = (depth > static_cast<float>(kNearest_m)) & (load(&matches.valid[i]) > 0.0f);
    const Floats iz = 1.0f / select(usable, depth, 1.0f);
    const Floats xn = (rx + t[0]) * iz, yn = (ry + t[1]) * iz;
    const auto fx = static_cast<float>(matches.live.fx), fy = static_cast<float>(matches.live.fy);
    const auto baseline = static_cast<float>(matches.live.baseline_m);
    along_u = fx * iz;
    along_v = fy * iz;
    u_by_z = -along_u * xn;
    v_by_z = -along_v * yn;
    d_by_z = -along_u * iz * baseline;
    ru = fx * xn + static_cast<float>(matches.live.cx) - load(&matches.u[i]);
    rv = fy * yn + static_cast<float>(matches.live.cy) - load(&matches.v[i]);
    rd = along_u * baseline + pose.live_offset - load(&matches.d[i]);
    ju = along_u * rx + u_by_z * rz;
    jv = along_v * ry + v_by_z * rz;
    jd = d_by_z * rz;
    wp = load(&matches.pixel_information[i]);
    wd = load(&matches.disparity_information[i]);
    const Floats variance = load(&matches.depth_variance[i]);
    depth_information = wp * (ju * ju + jv * jv) + wd * jd * jd;
    kept = 1.0f / (1.0f + variance * depth_information);
    kappa = variance * kept;
    hr = wp * (ju * ru + jv * rv) + wd * jd * rd;
    // As a sum of squares, with the depth error that fits best: rᵀD⁻¹r − κ(jᵀD⁻¹r)² would cancel
    // to anything, even below zero, where residuals are large.
    const Floats depth_error = kappa * hr;
    const Floats eu = ru - depth_error * ju, ev = rv - depth_error * jv, ed = rd - depth_error * jd;
    chi2 = wp * (eu * eu + ev * ev) + wd * ed * ed + depth_error * hr * kept;
  }
};

} // namespace engram::ENGRAM_ISA
