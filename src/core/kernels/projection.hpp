// Stereo projection of a point of one camera into another, with its derivatives.
#pragma once

#include "kernels/rigid.hpp"

namespace engram::ENGRAM_ISA {

constexpr double kNearest_m = 0.1; // nothing closer can be seen by both cameras of a pair

// A stereo measurement is (left u, left v, disparity): left u, left v and right u = u − disparity,
// in coordinates whose errors are independent.
struct Linearised {
  bool in_front;
  Vec3 stereo;
  // d(stereo) / d(left perturbation of reference_from_live), [translation, rotation].
  double by_pose[3][6];
  // d(stereo) / d(relative error of the point's depth along its ray in the reference).
  Vec3 by_depth;
};

inline Vec3 project(const Camera &camera, const Vec3 &point) {
  const double inverse_z = 1 / point[2];
  return {camera.fx * point[0] * inverse_z + camera.cx, camera.fy * point[1] * inverse_z + camera.cy,
          camera.fx * camera.baseline_m * inverse_z};
}

inline Linearised linearise(const Camera &camera, const Pose &reference_from_live,
                            const Vec3 &point_in_reference) {
  Linearised result;
  const Vec3 point = transform_back(reference_from_live, point_in_reference);
  result.in_front = point[2] > kNearest_m;
  if (!result.in_front)
    return result;
  result.stereo = project(camera, point);
  const double inverse_z = 1 / point[2];
  const double along_u = camera.fx * inverse_z, along_v = camera.fy * inverse_z;
  const Vec3 gradients[3] = {
      {along_u, 0, -along_u * point[0] * inverse_z},
      {0, along_v, -along_v * point[1] * inverse_z},
      {0, 0, -along_u * camera.baseline_m * inverse_z},
  };
  const Vec3 ray = rotate_back(reference_from_live, point_in_reference);
  for (int k = 0; k < 3; ++k) {
    // Moving the live camera by a perturbation moves the point by its opposite.
    const Vec3 a = -1.0 * rotate(reference_from_live, gradients[k]);
    const Vec3 b = cross(point_in_reference, a);
    for (int i = 0; i < 3; ++i) {
      result.by_pose[k][i] = a[i];
      result.by_pose[k][3 + i] = b[i];
    }
    result.by_depth[k] = dot(gradients[k], ray);
  }
  return result;
}

} // namespace engram::ENGRAM_ISA
