// Bundle adjustment by the Schur complement (Triggs et al. 2000, §6; Hartley & Zisserman, A6.3):
// landmarks are eliminated one by one, what remains is a dense system of the poses and of the
// disparity offset that all observations share.
#include "kernels/window_ba.hpp"

#include <cmath>
#include <cstring>
#include <limits>

#include "kernels/projection.hpp"

namespace engram::ENGRAM_ISA {
namespace {

// The six tangent coordinates of a pose in the lanes of one vector; the last two are zero.
typedef double Tangent __attribute__((vector_size(64)));

struct Observation {
  int32_t frame;
  Vec3 stereo;
  double pixel_information, disparity_information;
};

struct Landmark {
  int32_t begin, end; // its observations
  int32_t track;
  Vec3 point;
};

// A pose's share in a landmark's normal equations, one column per coordinate of the landmark.
struct Coupling {
  Tangent by_x, by_y, by_z;
};

Tangent tangent(const double values[6]) {
  return Tangent{values[0], values[1], values[2], values[3], values[4], values[5], 0, 0};
}

// Inverse of a symmetric 3×3 matrix (xx, xy, xz, yy, yz, zz) in the same layout.
bool invert3(const double m[6], double result[6]) {
  const double a = m[3] * m[5] - m[4] * m[4], b = m[2] * m[4] - m[1] * m[5],
               c = m[1] * m[4] - m[2] * m[3];
  const double determinant = m[0] * a + m[1] * b + m[2] * c;
  if (!(determinant > 0))
    return false;
  const double s = 1 / determinant;
  result[0] = s * a, result[1] = s * b, result[2] = s * c;
  result[3] = s * (m[0] * m[5] - m[2] * m[2]);
  result[4] = s * (m[1] * m[2] - m[0] * m[4]);
  result[5] = s * (m[0] * m[3] - m[1] * m[1]);
  return true;
}

Vec3 multiply3(const double m[6], const Vec3 &v) {
  return {m[0] * v[0] + m[1] * v[1] + m[2] * v[2], m[1] * v[0] + m[3] * v[1] + m[4] * v[2],
          m[2] * v[0] + m[4] * v[1] + m[5] * v[2]};
}

class Window {
public:
  Window(const Camera &camera, const std::vector<RigidTransform> &world_from_cam,
         const WindowObservations &observations, const WindowSettings &settings)
      : camera_(camera), settings_(settings), poses_(world_from_cam),
        free_(static_cast<int>(world_from_cam.size()) - settings.fixed),
        offset_(settings.offset_px) {
    group_by_landmark(observations);
  }

  WindowResult run() {
    WindowResult result;
    if (landmarks_.empty() || free_ <= 0)
      return result;
    double damping = 1e-4;
    double cost = linearise_all();
    result.cost_before = cost;
    for (int i = 0; i < settings_.iterations; ++i) {
      const std::vector<Pose> poses = poses_;
      const std::vector<Landmark> landmarks = landmarks_;
      const double offset = offset_;
      if (!eliminate(damping) || !step())
        break;
      const double there = cost_only();
      if (there < cost) {
        constexpr double kConverged = 1e-3; // of the cost: what is left moves no pose visibly
        const bool converged = cost - there < kConverged * cost;
        linearise_all();
        cost = there;
        damping = std::max(0.1 * damping, 1e-9);
        if (converged)
          break;
      } else {
        poses_ = poses;
        landmarks_ = landmarks;
        offset_ = offset;
        damping *= 10;
      }
    }
    finish(cost, result);
    return result;
  }

private:
  // Landmarks that are seen at least twice, with their observations side by side.
  void group_by_landmark(const WindowObservations &given) {
    std::vector<int32_t> starts(given.tracks + 1, 0);
    for (int64_t k = 0; k < given.count; ++k)
      ++starts[given.track[k] + 1];
    for (int32_t track = 0; track < given.tracks; ++track)
      starts[track + 1] += starts[track];
    std::vector<int32_t> order(given.count), next(starts.begin(), starts.end() - 1);
    for (int64_t k = 0; k < given.count; ++k)
      order[next[given.track[k]]++] = static_cast<int32_t>(k);
    for (int32_t track = 0; track < given.tracks; ++track) {
      if (starts[track + 1] - starts[track] < 2)
        continue;
      const auto begin = static_cast<int32_t>(observations_.size());
      for (int32_t n = starts[track]; n < starts[track + 1]; ++n) {
        const int32_t k = order[n];
        const float *s = given.stereo + 3 * k;
        const double pixel = given.pixel_sigma_px[k], disparity = given.disparity_sigma_px[k];
        observations_.push_back({given.frame[k],
                                 {s[0], s[1], s[2]},
                                 1 / (pixel * pixel),
                                 1 / (disparity * disparity)});
      }
      const auto end = static_cast<int32_t>(observations_.size());
      landmarks_.push_back({begin, end, track, first_guess(begin, end)});
    }
    couplings_.resize(observations_.size());
    point_hessians_.resize(6 * landmarks_.size());
    point_inverses_.resize(6 * landmarks_.size());
    point_gradients_.resize(landmarks_.size());
    point_by_offset_.resize(landmarks_.size());
  }

  // Where the closest of its observations puts it.
  Vec3 first_guess(int32_t begin, int32_t end) const {
    int32_t closest = begin;
    for (int32_t k = begin; k < end; ++k)
      if (observations_[k].stereo[2] > observations_[closest].stereo[2])
        closest = k;
    const Observation &seen = observations_[closest];
    // An offset cannot be all there is of a disparity.
    const double disparity = std::max(seen.stereo[2] - offset_, 0.1 * seen.stereo[2]);
    const double depth = camera_.fx * camera_.baseline_m / disparity;
    return transform(poses_[seen.frame], {(seen.stereo[0] - camera_.cx) / camera_.fx * depth,
                                          (seen.stereo[1] - camera_.cy) / camera_.fy * depth,
                                          depth});
  }

  // Fills the normal equations at the present estimate; returns the robust cost.
  double linearise_all() {
    const Tangent zero{};
    pose_hessians_.assign(6 * free_, zero);
    pose_gradients_.assign(free_, zero);
    pose_by_offset_.assign(free_, zero);
    offset_hessian_ = prior_information();
    offset_gradient_ = prior_information() * (offset_ - settings_.offset_px);
    double cost = prior_cost();
    for (size_t l = 0; l < landmarks_.size(); ++l) {
      double *hll = &point_hessians_[6 * l];
      std::fill(hll, hll + 6, 0.0);
      point_gradients_[l] = {0, 0, 0};
      point_by_offset_[l] = {0, 0, 0};
      for (int32_t k = landmarks_[l].begin; k < landmarks_[l].end; ++k)
        cost += linearise_one(k, l, hll);
    }
    return cost;
  }

  double prior_information() const {
    return 1 / (settings_.offset_sigma_px * settings_.offset_sigma_px);
  }
  double prior_cost() const {
    const double away = offset_ - settings_.offset_px;
    return prior_information() * away * away;
  }

  Vec3 residual_of(const Vec3 &stereo, const Observation &seen) const {
    return stereo + Vec3{0, 0, offset_} - seen.stereo;
  }

  double linearise_one(int32_t k, size_t l, double hll[6]) {
    const Observation &seen = observations_[k];
    Coupling &coupling = couplings_[k];
    coupling = Coupling{};
    const Linearised there = linearise(camera_, poses_[seen.frame], landmarks_[l].point);
    if (!there.in_front)
      return settings_.chi2;
    const Vec3 residual = residual_of(there.stereo, seen);
    const Vec3 information = {seen.pixel_information, seen.pixel_information,
                              seen.disparity_information};
    double chi2 = 0;
    for (int i = 0; i < 3; ++i)
      chi2 += information[i] * residual[i] * residual[i];
    const double shrink = 1 / (1 + chi2 / settings_.chi2); // Geman–McClure
    const int free = seen.frame - settings_.fixed;
    for (int i = 0; i < 3; ++i) {
      const double *row = there.by_pose[i];
      const Tangent by_pose = tangent(row);
      // The point moves the residual opposite to a translation of the camera.
      const double px = -row[0], py = -row[1], pz = -row[2];
      const double weight = shrink * shrink * information[i], weighted = weight * residual[i];
      hll[0] += weight * px * px, hll[1] += weight * px * py, hll[2] += weight * px * pz;
      hll[3] += weight * py * py, hll[4] += weight * py * pz, hll[5] += weight * pz * pz;
      const Vec3 by_point = {px, py, pz};
      point_gradients_[l] = point_gradients_[l] + weighted * by_point;
      if (i == 2) { // the disparity
        offset_hessian_ += weight;
        offset_gradient_ += weighted;
        point_by_offset_[l] = point_by_offset_[l] + weight * by_point;
        if (free >= 0)
          pose_by_offset_[free] += weight * by_pose;
      }
      if (free < 0)
        continue;
      coupling.by_x += (weight * px) * by_pose;
      coupling.by_y += (weight * py) * by_pose;
      coupling.by_z += (weight * pz) * by_pose;
      pose_gradients_[free] += weighted * by_pose;
      for (int a = 0; a < 6; ++a)
        pose_hessians_[6 * free + a] += (weight * row[a]) * by_pose;
    }
    return chi2 * shrink;
  }

  double cost_only() const {
    double cost = prior_cost();
    for (const Landmark &landmark : landmarks_)
      for (int32_t k = landmark.begin; k < landmark.end; ++k) {
        const Observation &seen = observations_[k];
        const Vec3 point = transform_back(poses_[seen.frame], landmark.point);
        if (point[2] <= kNearest_m) {
          cost += settings_.chi2;
          continue;
        }
        const Vec3 r = residual_of(project(camera_, point), seen);
        const double chi2 = seen.pixel_information * (r[0] * r[0] + r[1] * r[1]) +
                            seen.disparity_information * r[2] * r[2];
        cost += chi2 / (1 + chi2 / settings_.chi2);
      }
    return cost;
  }

  // The unknowns that remain: the free poses, then the offset.
  int size() const { return 6 * free_ + 1; }

  // The reduced system S = Hpp − Σ Hpl Hll⁻¹ Hlp, factorised in place.
  bool eliminate(double damping) {
    reduced_by_offset_ = pose_by_offset_;
    reduced_offset_hessian_ = (1 + damping) * offset_hessian_;
    reduced_offset_gradient_ = offset_gradient_;
    blocks_.assign(static_cast<size_t>(free_) * free_ * 6, Tangent{});
    reduced_gradient_ = pose_gradients_;
    for (int p = 0; p < free_; ++p)
      for (int a = 0; a < 6; ++a) {
        Tangent row = pose_hessians_[6 * p + a];
        row[a] *= 1 + damping;
        blocks_[(p * free_ + p) * 6 + a] = row;
      }
    for (size_t l = 0; l < landmarks_.size(); ++l) {
      double damped[6];
      std::copy(&point_hessians_[6 * l], &point_hessians_[6 * l] + 6, damped);
      for (const int diagonal : {0, 3, 5})
        damped[diagonal] *= 1 + damping;
      double *inverse = &point_inverses_[6 * l];
      if (!invert3(damped, inverse)) // behind the cameras: without weight, without effect
        std::fill(inverse, inverse + 6, 0.0);
      const Vec3 solved = multiply3(inverse, point_by_offset_[l]);
      reduced_offset_hessian_ -= dot(point_by_offset_[l], solved);
      reduced_offset_gradient_ -= dot(point_gradients_[l], solved);
      eliminate_one(landmarks_[l], inverse, point_gradients_[l], solved);
    }
    return factorise_system();
  }

  bool factorise_system() {
    const int size = this->size(), last = size - 1;
    system_.assign(static_cast<size_t>(size) * size, 0);
    system_[last * size + last] = reduced_offset_hessian_;
    for (int p = 0; p < free_; ++p)
      for (int a = 0; a < 6; ++a)
        system_[last * size + 6 * p + a] = reduced_by_offset_[p][a];
    for (int p = 0; p < free_; ++p)
      for (int q = 0; q <= p; ++q)
        for (int a = 0; a < 6; ++a)
          for (int b = 0; b < 6; ++b)
            system_[(6 * p + a) * size + 6 * q + b] = blocks_[(p * free_ + q) * 6 + a][b];
    return factorise(system_.data(), size);
  }

  // `offset` is Hll⁻¹ times the landmark's share in the offset.
  void eliminate_one(const Landmark &landmark, const double inverse[6], const Vec3 &gradient,
                     const Vec3 &offset) {
    for (int32_t k = landmark.begin; k < landmark.end; ++k) {
      const int p = observations_[k].frame - settings_.fixed;
      if (p < 0)
        continue;
      const Coupling &c = couplings_[k];
      const Tangent x = inverse[0] * c.by_x + inverse[1] * c.by_y + inverse[2] * c.by_z;
      const Tangent y = inverse[1] * c.by_x + inverse[3] * c.by_y + inverse[4] * c.by_z;
      const Tangent z = inverse[2] * c.by_x + inverse[4] * c.by_y + inverse[5] * c.by_z;
      reduced_by_offset_[p] -= offset[0] * c.by_x + offset[1] * c.by_y + offset[2] * c.by_z;
      reduced_gradient_[p] -= gradient[0] * x + gradient[1] * y + gradient[2] * z;
      for (int32_t other = landmark.begin; other < landmark.end; ++other) {
        const int q = observations_[other].frame - settings_.fixed;
        if (q < 0 || q > p)
          continue;
        const Coupling &o = couplings_[other];
        Tangent *block = &blocks_[(p * free_ + q) * 6];
        for (int a = 0; a < 6; ++a)
          block[a] -= x[a] * o.by_x + y[a] * o.by_y + z[a] * o.by_z;
      }
    }
  }

  // Moves poses and landmarks by the solution of the eliminated system.
  bool step() {
    const int size = this->size();
    std::vector<double> solution(size);
    solution.back() = -reduced_offset_gradient_;
    for (int p = 0; p < free_; ++p)
      for (int a = 0; a < 6; ++a)
        solution[6 * p + a] = -reduced_gradient_[p][a];
    solve_factorised(system_.data(), size, solution.data());
    for (const double value : solution)
      if (!std::isfinite(value))
        return false;
    for (size_t l = 0; l < landmarks_.size(); ++l) {
      Vec3 right = -1.0 * point_gradients_[l] - solution.back() * point_by_offset_[l];
      for (int32_t k = landmarks_[l].begin; k < landmarks_[l].end; ++k) {
        const int p = observations_[k].frame - settings_.fixed;
        if (p < 0)
          continue;
        const Tangent moved = tangent(&solution[6 * p]);
        right = right - Vec3{inner(couplings_[k].by_x, moved), inner(couplings_[k].by_y, moved),
                             inner(couplings_[k].by_z, moved)};
      }
      landmarks_[l].point = landmarks_[l].point + multiply3(&point_inverses_[6 * l], right);
    }
    for (int p = 0; p < free_; ++p)
      poses_[settings_.fixed + p] = perturbed(poses_[settings_.fixed + p], &solution[6 * p]);
    offset_ += solution.back();
    return true;
  }

  static double inner(Tangent a, Tangent b) {
    const Tangent products = a * b;
    return products[0] + products[1] + products[2] + products[3] + products[4] + products[5];
  }

  void finish(double cost, WindowResult &result) {
    if (!eliminate(0))
      return;
    result.solved = true;
    result.cost_after = cost;
    result.offset_px = offset_;
    result.world_from_cam = poses_;
    const int size = this->size(), poses = size - 1;
    std::vector<double> covariance(static_cast<size_t>(size) * size);
    invert_factorised(system_.data(), size, covariance.data());
    for (int row = 0; row < poses; ++row)
      result.covariance.insert(result.covariance.end(), covariance.begin() + row * size,
                               covariance.begin() + row * size + poses);
    for (const Landmark &landmark : landmarks_) {
      result.points.resize(std::max<size_t>(result.points.size(), 3 * (landmark.track + 1)),
                           std::numeric_limits<double>::quiet_NaN());
      std::copy(landmark.point.begin(), landmark.point.end(),
                result.points.begin() + 3 * landmark.track);
    }
  }

  Camera camera_;
  WindowSettings settings_;
  std::vector<Pose> poses_;
  int free_;
  std::vector<Observation> observations_;
  std::vector<Landmark> landmarks_;
  std::vector<Coupling> couplings_;
  std::vector<double> point_hessians_, point_inverses_;
  std::vector<Vec3> point_gradients_, point_by_offset_;
  std::vector<Tangent> pose_by_offset_, reduced_by_offset_;
  double offset_, offset_hessian_ = 0, offset_gradient_ = 0;
  double reduced_offset_hessian_ = 0, reduced_offset_gradient_ = 0;
  std::vector<Tangent> pose_hessians_, pose_gradients_, reduced_gradient_, blocks_;
  std::vector<double> system_;
};

} // namespace

WindowResult adjust_window(const Camera &camera, const std::vector<RigidTransform> &world_from_cam,
                           const WindowObservations &observations,
                           const WindowSettings &settings) {
  WindowResult result = Window(camera, world_from_cam, observations, settings).run();
  result.points.resize(3 * static_cast<size_t>(observations.tracks),
                       std::numeric_limits<double>::quiet_NaN());
  return result;
}

} // namespace engram::ENGRAM_ISA
