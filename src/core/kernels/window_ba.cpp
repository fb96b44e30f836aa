// Bundle adjustment by the Schur complement (Triggs et al. 2000, §6; Hartley & Zisserman, A6.3):
// landmarks are eliminated, what remains is a dense system of the poses and of the disparity offset
// that all observations share.
//
// An observation's residual depends on pose and landmark through their difference only: with A its
// derivative by the landmark x, that by a left perturbation of the pose is A C, C = [−I, [x]×]. So
// an observation enters all blocks through the 3×3 matrix M = AᵀWA and the vector AᵀWr, and a
// landmark adds Cᵀ (δ_pq M_p − M_p H⁻¹ M_q) C to the block of poses p and q, H = Σ M. Eight
// landmarks are worked on side by side, one per lane.
#include "kernels/window_ba.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <string>
#include <tuple>

#include "kernels/cholesky.hpp"
#include "kernels/double_lanes.hpp"
#include "kernels/projection.hpp"

namespace engram::ENGRAM_ISA {
namespace {

constexpr int kLandmarks = kDoubleLanes;

typedef Vec3Lanes Vector;
typedef std::array<Doubles, 6> Symmetric; // xx, xy, xz, yy, yz, zz
typedef std::array<Doubles, 9> Matrix;    // row-major

Vector operator-(const Vector &a, const Vector &b) {
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}

Vector multiply(const Symmetric &m, const Vector &v) {
  return {m[0] * v[0] + m[1] * v[1] + m[2] * v[2], m[1] * v[0] + m[3] * v[1] + m[4] * v[2],
          m[2] * v[0] + m[4] * v[1] + m[5] * v[2]};
}

Vector multiply(const Matrix &m, const Vector &v) {
  return {m[0] * v[0] + m[1] * v[1] + m[2] * v[2], m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
          m[6] * v[0] + m[7] * v[1] + m[8] * v[2]};
}

Vector column_of(const Symmetric &m, int i) {
  constexpr int kEntry[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
  return {m[kEntry[i][0]], m[kEntry[i][1]], m[kEntry[i][2]]};
}

Matrix multiply(const Symmetric &a, const Symmetric &b) {
  Matrix result;
  for (int c = 0; c < 3; ++c) {
    const Vector along = multiply(a, column_of(b, c));
    for (int r = 0; r < 3; ++r)
      result[3 * r + c] = along[r];
  }
  return result;
}

Matrix multiply(const Matrix &a, const Symmetric &b) {
  Matrix result;
  for (int c = 0; c < 3; ++c) {
    const Vector along = multiply(a, column_of(b, c));
    for (int r = 0; r < 3; ++r)
      result[3 * r + c] = along[r];
  }
  return result;
}

// Inverse, and zero where it is not positive definite: a landmark behind all cameras is without
// weight and without effect.
Symmetric inverse(const Symmetric &m) {
  const Doubles a = m[3] * m[5] - m[4] * m[4], b = m[2] * m[4] - m[1] * m[5],
                c = m[1] * m[4] - m[2] * m[3];
  const Doubles determinant = m[0] * a + m[1] * b + m[2] * c;
  const Longs regular = determinant > 0.0;
  const Doubles s = select(regular, 1.0 / select(regular, determinant, 1.0), 0.0);
  return {s * a,
          s * b,
          s * c,
          s * (m[0] * m[5] - m[2] * m[2]),
          s * (m[1] * m[2] - m[0] * m[4]),
          s * (m[0] * m[3] - m[1] * m[1])};
}

// What one frame measured of eight landmarks; without information where it did not see one.
struct Measured {
  Vector stereo;
  Doubles pixel_information, disparity_information;
};

// Its share in the normal equations.
struct Share {
  Symmetric hessian; // AᵀWA
  Vector gradient;   // AᵀWr
  Vector by_offset;  // AᵀW of the disparity
};

struct Landmarks {
  std::array<int32_t, kLandmarks> tracks; // −1 in the padding
  Vector points;
};

// A share of all landmarks in a block of the reduced system, still in lanes.
typedef std::array<std::array<Doubles, 6>, 6> BlockLanes;
typedef std::array<Doubles, 6> RowLanes;

void add_to_row(const Vector &points, const Vector &v, RowLanes &row) {
  const Vector turning = cross(points, v); // [x]×ᵀ = −[x]×, hence the sign
  for (int i = 0; i < 3; ++i) {
    row[i] -= v[i];
    row[3 + i] -= turning[i];
  }
}

// Cᵀ N C.
void add_to_block(const Vector &x, const Matrix &n, BlockLanes &block) {
  const Matrix nx = { // N [x]×
      n[1] * x[2] - n[2] * x[1], n[2] * x[0] - n[0] * x[2], n[0] * x[1] - n[1] * x[0],
      n[4] * x[2] - n[5] * x[1], n[5] * x[0] - n[3] * x[2], n[3] * x[1] - n[4] * x[0],
      n[7] * x[2] - n[8] * x[1], n[8] * x[0] - n[6] * x[2], n[6] * x[1] - n[7] * x[0]};
  for (int c = 0; c < 3; ++c) {
    const Vector below = cross(x, {n[c], n[3 + c], n[6 + c]});
    const Vector corner = cross(x, {nx[c], nx[3 + c], nx[6 + c]});
    for (int r = 0; r < 3; ++r) {
      block[r][c] += n[3 * r + c];
      block[r][3 + c] -= nx[3 * r + c];
      block[3 + r][c] += below[r];
      block[3 + r][3 + c] -= corner[r];
    }
  }
}

// Of eight landmarks: their own block, inverted, and right-hand sides.
struct Solved {
  Symmetric inverse;
  Vector gradient, by_offset;
};

// A megabyte, kept between calls: fresh pages would cost a tenth of the work.
struct Scratch {
  // By group of landmarks and frame.
  std::vector<uint8_t> present;
  std::vector<Measured> measured;
  std::vector<Share> shares;
  std::vector<Matrix> carried; // M H⁻¹
  std::vector<Solved> solved;  // by group
};

class Window {
public:
  Window(const Camera &camera, const std::vector<RigidTransform> &world_from_cam,
         const WindowObservations &observations, const WindowSettings &settings, Scratch &scratch)
      : present_(scratch.present), measured_(scratch.measured), shares_(scratch.shares),
        carried_(scratch.carried), solved_(scratch.solved), camera_(camera), settings_(settings), poses_(world_from_cam),
        frames_(static_cast<int>(world_from_cam.size())), free_(frames_ - settings.fixed),
        tracks_(observations.tracks), offset_(settings.offset_px) {
    group_by_landmark(observations);
  }

  WindowResult run() {
    WindowResult result;
    result.points.assign(3 * static_cast<size_t>(tracks_),
                         std::numeric_limits<double>::quiet_NaN());
    if (groups_.empty() || free_ <= 0)
      return result;
    double damping = 1e-4;
    double cost = linearise();
    result.cost_before = cost;
    for (int i = 0; i < settings_.iterations; ++i) {
      const std::vector<Pose> poses = poses_;
      const std::vector<Landmarks> groups = groups_;
      const double offset = offset_;
      if (!eliminate(damping) || !step())
        break;
      const double there = cost_only();
      if (there < cost) {
        constexpr double kConverged = 1e-3; // of the cost: what is left moves no pose visibly
        const bool converged = cost - there < kConverged * cost;
        linearise();
        cost = there;
        damping = std::max(0.1 * damping, 1e-9);
        if (converged)
          break;
      } else {
        poses_ = poses;
        groups_ = groups;
        offset_ = offset;
        damping *= 10;
      }
    }
    finish(cost, result);
    return result;
  }

private:
  // Landmarks that are seen at least twice, eight by eight; those that the same frames see side by
  // side, so that few lanes are idle.
  void group_by_landmark(const WindowObservations &given) {
    std::vector<int32_t> starts(given.tracks + 1, 0);
    for (int64_t k = 0; k < given.count; ++k)
      ++starts[given.track[k] + 1];
    for (int32_t track = 0; track < given.tracks; ++track)
      starts[track + 1] += starts[track];
    std::vector<int32_t> order(given.count), next(starts.begin(), starts.end() - 1);
    for (int64_t k = 0; k < given.count; ++k)
      order[next[given.track[k]]++] = static_cast<int32_t>(k);
    std::vector<Seen> seen;
    for (int32_t track = 0; track < given.tracks; ++track)
      if (starts[track + 1] - starts[track] >= 2)
        seen.push_back(look_at(given, track, &order[starts[track]], &order[0] + starts[track + 1]));
    std::sort(seen.begin(), seen.end(), [](const Seen &a, const Seen &b) {
      return std::tie(a.first_frame, a.last_frame, a.track) <
             std::tie(b.first_frame, b.last_frame, b.track);
    });
    const size_t groups = (seen.size() + kLandmarks - 1) / kLandmarks;
    groups_.assign(groups, Landmarks{{-1, -1, -1, -1, -1, -1, -1, -1}, {}});
    measured_.assign(groups * frames_, Measured{});
    present_.assign(groups * frames_, 0);
    shares_.resize(groups * frames_);
    for (size_t n = 0; n < seen.size(); ++n)
      place(given, seen[n], n / kLandmarks, static_cast<int>(n % kLandmarks));
  }

  // A landmark and its observations, as numbers of the given ones.
  struct Seen {
    int32_t first_frame, last_frame, track;
    const int32_t *begin, *end;
    std::array<double, 3> point;
  };

  Seen look_at(const WindowObservations &given, int32_t track, const int32_t *begin,
               const int32_t *end) {
    Seen seen{given.frame[*begin], given.frame[*begin], track, begin, end, {}};
    seen_in_.assign(frames_, 0);
    for (const int32_t *k = begin; k < end; ++k) {
      const int32_t frame = given.frame[*k];
      if (seen_in_[frame]++)
        throw std::invalid_argument("adjust_window: track " + std::to_string(track) +
                                    " is seen twice in frame " + std::to_string(frame));
      seen.first_frame = std::min(seen.first_frame, frame);
      seen.last_frame = std::max(seen.last_frame, frame);
    }
    return seen;
  }

  void place(const WindowObservations &given, const Seen &seen, size_t group, int lane) {
    const Vec3 point = first_guess(given, seen);
    for (int i = 0; i < 3; ++i)
      groups_[group].points[i][lane] = point[i];
    groups_[group].tracks[lane] = seen.track;
    for (const int32_t *k = seen.begin; k < seen.end; ++k) {
      const size_t slot = group * frames_ + given.frame[*k];
      Measured &measured = measured_[slot];
      present_[slot] = 1;
      for (int i = 0; i < 3; ++i)
        measured.stereo[i][lane] = given.stereo[3 * *k + i];
      const double pixel = given.pixel_sigma_px[*k], disparity = given.disparity_sigma_px[*k];
      measured.pixel_information[lane] = 1 / (pixel * pixel);
      measured.disparity_information[lane] = 1 / (disparity * disparity);
    }
  }

  // Where the closest of its observations puts it.
  Vec3 first_guess(const WindowObservations &given, const Seen &seen) const {
    const int32_t closest = *std::max_element(seen.begin, seen.end, [&](int32_t a, int32_t b) {
      return given.stereo[3 * a + 2] < given.stereo[3 * b + 2];
    });
    const float *stereo = given.stereo + 3 * closest;
    // An offset cannot be all there is of a disparity.
    const double disparity = std::max(stereo[2] - offset_, 0.1 * stereo[2]);
    const double depth = camera_.fx * camera_.baseline_m / disparity;
    return transform(poses_[given.frame[closest]],
                     {(stereo[0] - camera_.cx) / camera_.fx * depth,
                      (stereo[1] - camera_.cy) / camera_.fy * depth, depth});
  }

  // A frame's residuals of eight landmarks and what they weigh.
  struct Residuals {
    Vector in_cam, stereo;
    Doubles inverse_z, chi2, shrink;
    Longs in_front;
    Doubles cost;
  };

  Residuals residuals_of(const Pose &pose, const Vector &points, const Measured &measured) const {
    Residuals result;
    const auto &r = pose.rotation;
    const Vector away = {points[0] - pose.translation[0], points[1] - pose.translation[1],
                         points[2] - pose.translation[2]};
    for (int i = 0; i < 3; ++i)
      result.in_cam[i] = r[i] * away[0] + r[3 + i] * away[1] + r[6 + i] * away[2];
    result.in_front = result.in_cam[2] > kNearest_m;
    const Doubles iz = result.inverse_z = 1.0 / select(result.in_front, result.in_cam[2], 1.0);
    result.stereo = {camera_.fx * result.in_cam[0] * iz + camera_.cx - measured.stereo[0],
                     camera_.fy * result.in_cam[1] * iz + camera_.cy - measured.stereo[1],
                     camera_.fx * camera_.baseline_m * iz + offset_ - measured.stereo[2]};
    const Vector &s = result.stereo;
    result.chi2 = measured.pixel_information * (s[0] * s[0] + s[1] * s[1]) +
                  measured.disparity_information * s[2] * s[2];
    result.shrink = 1.0 / (1.0 + result.chi2 / settings_.chi2); // Geman–McClure
    const Doubles behind = select(measured.pixel_information > 0.0, Doubles(settings_.chi2), 0.0);
    result.cost = select(result.in_front, result.chi2 * result.shrink, behind);
    return result;
  }

  double prior_information() const {
    return 1 / (settings_.offset_sigma_px * settings_.offset_sigma_px);
  }
  double prior_cost() const {
    const double away = offset_ - settings_.offset_px;
    return prior_information() * away * away;
  }

  // Fills the shares of all observations at the present estimate; returns the robust cost.
  double linearise() {
    OffsetLanes offset{};
    Doubles cost(0);
    for (size_t g = 0; g < groups_.size(); ++g)
      for (int p = 0; p < frames_; ++p)
        if (const size_t slot = g * frames_ + p; present_[slot])
          cost += linearise_one(poses_[p], groups_[g].points, measured_[slot], shares_[slot],
                                offset);
    offset_hessian_ = prior_information() + sum(offset.hessian);
    offset_gradient_ =
        prior_information() * (offset_ - settings_.offset_px) + sum(offset.gradient);
    return sum(cost) + prior_cost();
  }

  struct OffsetLanes {
    Doubles hessian, gradient;
  };

  Doubles linearise_one(const Pose &pose, const Vector &points, const Measured &measured,
                        Share &share, OffsetLanes &offset) const {
    const Residuals there = residuals_of(pose, points, measured);
    const Doubles iz = there.inverse_z;
    const Doubles robust = select(there.in_front, there.shrink * there.shrink, 0.0);
    const Doubles pixel = robust * measured.pixel_information;
    const Doubles disparity = robust * measured.disparity_information;
    const Doubles along_u = camera_.fx * iz, along_v = camera_.fy * iz;
    const Doubles u_by_z = -along_u * there.in_cam[0] * iz, v_by_z = -along_v * there.in_cam[1] * iz,
                  d_by_z = -along_u * camera_.baseline_m * iz;
    Vector u, v, d; // the rows of A
    for (int i = 0; i < 3; ++i) {
      const double *axis = &pose.rotation[3 * i];
      u[i] = along_u * axis[0] + u_by_z * axis[2];
      v[i] = along_v * axis[1] + v_by_z * axis[2];
      d[i] = d_by_z * axis[2];
    }
    int entry = 0;
    for (int i = 0; i < 3; ++i) {
      const Doubles pu = pixel * u[i], pv = pixel * v[i], pd = disparity * d[i];
      share.gradient[i] = pu * there.stereo[0] + pv * there.stereo[1] + pd * there.stereo[2];
      share.by_offset[i] = pd;
      for (int j = i; j < 3; ++j)
        share.hessian[entry++] = pu * u[j] + pv * v[j] + pd * d[j];
    }
    offset.hessian += disparity;
    offset.gradient += disparity * there.stereo[2];
    return there.cost;
  }

  double cost_only() const {
    Doubles cost(0);
    for (size_t g = 0; g < groups_.size(); ++g)
      for (int p = 0; p < frames_; ++p)
        if (const size_t slot = g * frames_ + p; present_[slot])
          cost += residuals_of(poses_[p], groups_[g].points, measured_[slot]).cost;
    return sum(cost) + prior_cost();
  }

  // The unknowns that remain: the free poses, then the offset.
  int size() const { return 6 * free_ + 1; }

  // The reduced system S = Hpp − Σ Hpl Hll⁻¹ Hlp, factorised in place, and its right-hand side.
  bool eliminate(double damping) {
    system_.assign(static_cast<size_t>(size()) * size(), 0);
    right_.assign(size(), 0);
    eliminate_landmarks(damping);
    for (int p = 0; p < free_; ++p)
      for (int q = p; q < free_; ++q)
        add_block(p, q);
    return factorise_upper(system_.data(), size());
  }

  // Inverts the landmarks' own blocks, and fills all of the system but the poses' blocks.
  void eliminate_landmarks(double damping) {
    std::vector<PoseLanes> lanes(free_);
    OffsetLanes offset{};
    solved_.resize(groups_.size());
    carried_.resize(shares_.size());
    for (size_t g = 0; g < groups_.size(); ++g) {
      const Vector &points = groups_[g].points;
      const Share total = total_of(g);
      Symmetric damped = total.hessian;
      for (const int diagonal : {0, 3, 5})
        damped[diagonal] *= 1 + damping;
      Solved &solved = solved_[g];
      solved = {inverse(damped), total.gradient, total.by_offset};
      const Vector by_gradient = multiply(solved.inverse, total.gradient);
      const Vector by_offset = multiply(solved.inverse, total.by_offset);
      offset.hessian += dot(total.by_offset, by_offset);
      offset.gradient += dot(total.gradient, by_offset);
      for (int p = 0; p < free_; ++p) {
        const size_t slot = slot_of(g, p);
        if (!present_[slot])
          continue;
        const Share &share = shares_[slot];
        carried_[slot] = multiply(share.hessian, solved.inverse);
        add_to_row(points, share.gradient - multiply(share.hessian, by_gradient),
                   lanes[p].gradient);
        add_to_row(points, share.by_offset - multiply(share.hessian, by_offset),
                   lanes[p].by_offset);
        add_to_diagonal(points, share.hessian, lanes[p].diagonal);
      }
    }
    const int last = size() - 1;
    system_[last * size() + last] = (1 + damping) * offset_hessian_ - sum(offset.hessian);
    right_[last] = sum(offset.gradient) - offset_gradient_;
    for (int p = 0; p < free_; ++p)
      for (int a = 0; a < 6; ++a) {
        const int row = 6 * p + a;
        system_[row * size() + row] = damping * sum(lanes[p].diagonal[a]);
        system_[row * size() + last] = sum(lanes[p].by_offset[a]);
        right_[row] = -sum(lanes[p].gradient[a]);
      }
  }

  struct PoseLanes {
    RowLanes gradient, by_offset, diagonal;
  };

  // The diagonal of Cᵀ M C.
  static void add_to_diagonal(const Vector &x, const Symmetric &m, RowLanes &diagonal) {
    const Doubles xx = x[0] * x[0], yy = x[1] * x[1], zz = x[2] * x[2];
    diagonal[0] += m[0];
    diagonal[1] += m[3];
    diagonal[2] += m[5];
    diagonal[3] += zz * m[3] - 2.0 * x[1] * x[2] * m[4] + yy * m[5];
    diagonal[4] += zz * m[0] - 2.0 * x[0] * x[2] * m[2] + xx * m[5];
    diagonal[5] += yy * m[0] - 2.0 * x[0] * x[1] * m[1] + xx * m[3];
  }

  // Over all frames, the held ones too.
  Share total_of(size_t group) const {
    Share total{};
    for (int p = 0; p < frames_; ++p) {
      const size_t slot = group * frames_ + p;
      if (!present_[slot])
        continue;
      for (int i = 0; i < 6; ++i)
        total.hessian[i] += shares_[slot].hessian[i];
      for (int i = 0; i < 3; ++i) {
        total.gradient[i] += shares_[slot].gradient[i];
        total.by_offset[i] += shares_[slot].by_offset[i];
      }
    }
    return total;
  }

  size_t slot_of(size_t group, int free_pose) const {
    return group * frames_ + settings_.fixed + free_pose;
  }

  // The block of free poses p ≤ q in the upper triangle.
  void add_block(int p, int q) {
    BlockLanes block{};
    for (size_t g = 0; g < groups_.size(); ++g) {
      const size_t row = slot_of(g, p), column = slot_of(g, q);
      if (!present_[row] || !present_[column])
        continue;
      Matrix n = multiply(carried_[row], shares_[column].hessian);
      for (Doubles &entry : n)
        entry = -entry;
      if (p == q) {
        const Symmetric &m = shares_[row].hessian;
        for (int r = 0; r < 3; ++r)
          for (int c = 0; c < 3; ++c)
            n[3 * r + c] += column_of(m, c)[r];
      }
      add_to_block(groups_[g].points, n, block);
    }
    for (int a = 0; a < 6; ++a)
      for (int b = p == q ? a : 0; b < 6; ++b)
        system_[(6 * p + a) * size() + 6 * q + b] += sum(block[a][b]);
  }

  // Moves poses and landmarks by the solution of the eliminated system.
  bool step() {
    std::vector<double> solution = right_;
    solve_upper(system_.data(), size(), solution.data(), 1);
    for (const double value : solution)
      if (!std::isfinite(value))
        return false;
    for (size_t g = 0; g < groups_.size(); ++g) {
      Vector &x = groups_[g].points;
      Vector right;
      for (int i = 0; i < 3; ++i)
        right[i] = -solved_[g].gradient[i] - solution.back() * solved_[g].by_offset[i];
      for (int p = 0; p < free_; ++p) {
        if (!present_[slot_of(g, p)])
          continue;
        const double *moved = &solution[6 * p];
        const Vector turned = cross(x, {moved[3], moved[4], moved[5]});
        const Vector shifted = {turned[0] - moved[0], turned[1] - moved[1], turned[2] - moved[2]};
        right = right - multiply(shares_[slot_of(g, p)].hessian, shifted);
      }
      const Vector by = multiply(solved_[g].inverse, right);
      for (int i = 0; i < 3; ++i)
        x[i] += by[i];
    }
    for (int p = 0; p < free_; ++p)
      poses_[settings_.fixed + p] = perturbed(poses_[settings_.fixed + p], &solution[6 * p]);
    offset_ += solution.back();
    return true;
  }

  void finish(double cost, WindowResult &result) {
    if (!eliminate(0))
      return;
    result.solved = true;
    result.cost_after = cost;
    result.offset_px = offset_;
    result.world_from_cam = poses_;
    const int poses = size() - 1;
    std::vector<double> covariance(system_.size());
    invert_upper(system_.data(), size(), covariance.data());
    for (int row = 0; row < poses; ++row)
      result.covariance.insert(result.covariance.end(), covariance.begin() + row * size(),
                               covariance.begin() + row * size() + poses);
    for (const Landmarks &group : groups_)
      for (int lane = 0; lane < kLandmarks; ++lane)
        if (const int32_t track = group.tracks[lane]; track >= 0)
          for (int i = 0; i < 3; ++i)
            result.points[3 * track + i] = group.points[i][lane];
  }

  std::vector<uint8_t> &present_;
  std::vector<Measured> &measured_;
  std::vector<Share> &shares_;
  std::vector<Matrix> &carried_;
  std::vector<Solved> &solved_;
  Camera camera_;
  WindowSettings settings_;
  std::vector<Pose> poses_;
  int frames_, free_, tracks_;
  double offset_, offset_hessian_ = 0, offset_gradient_ = 0;
  std::vector<Landmarks> groups_;
  std::vector<double> system_, right_;
  std::vector<int32_t> seen_in_;
};

} // namespace

WindowResult adjust_window(const Camera &camera, const std::vector<RigidTransform> &world_from_cam,
                           const WindowObservations &observations,
                           const WindowSettings &settings) {
  static thread_local Scratch kept;
  return Window(camera, world_from_cam, observations, settings, kept).run();
}

} // namespace engram::ENGRAM_ISA
