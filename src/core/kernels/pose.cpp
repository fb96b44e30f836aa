#include "kernels/pose.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "kernels/correspondences.hpp"
#include "kernels/matching.hpp"

namespace engram::ENGRAM_ISA {
namespace {

// SplitMix64 (Steele, Lea, Flood 2014).
class Random {
public:
  explicit Random(uint64_t seed) : state_(seed) {}

  // Uniform in [0, count): the high word of a product, bias below 2⁻³².
  uint32_t below(uint32_t count) {
    return static_cast<uint32_t>(((next() >> 32) * count) >> 32);
  }

private:
  uint64_t next() {
    uint64_t z = (state_ += 0x9e3779b97f4a7c15);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
    z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
    return z ^ (z >> 31);
  }

  uint64_t state_;
};

double power(double base, int exponent) {
  double result = 1;
  for (; exponent > 0; exponent >>= 1, base *= base)
    if (exponent & 1)
      result *= base;
  return result;
}

Vec3 point_of(const FrameView &frame, int32_t row) {
  const float *p = frame.points_in_cam + 3 * row;
  return {p[0], p[1], p[2]};
}

double relative_depth_sigma(const FrameView &frame, int32_t row) {
  return frame.disparity_sigma_px[row] / frame.disparity_px[row];
}

double pixel_sigma(const FrameView &frame, int32_t row, const MatchSettings &settings) {
  return settings.pixel_sigma_px * power(settings.octave_scale, frame.octaves[row]);
}

Correspondences correspondences(const FrameView &reference, const FrameView &live,
                                const std::vector<RowPair> &pairs, const MatchSettings &settings) {
  Correspondences matches(live.camera);
  for (const RowPair &pair : pairs) {
    const Vec3 x = point_of(reference, pair.reference), y = point_of(live, pair.live);
    // A reference pixel's error, brought to live pixels by the ratio of focal length and depth.
    const double magnification =
        live.camera.fx * x[2] / (reference.camera.fx * std::max(y[2], kNearest_m));
    const double own = pixel_sigma(live, pair.live, settings);
    const double other = magnification * pixel_sigma(reference, pair.reference, settings);
    const double disparity = live.disparity_sigma_px[pair.live];
    const double depth = relative_depth_sigma(reference, pair.reference);
    const float *pixel = live.pixels + 2 * pair.live;
    matches.add(x, {pixel[0], pixel[1], live.disparity_px[pair.live]}, own * own + other * other,
                disparity * disparity, depth * depth);
  }
  matches.pad();
  return matches;
}

struct Score {
  float cost = std::numeric_limits<float>::max();
  int32_t inliers = 0;
};

// MSAC (Torr & Zisserman 2000): the truncated sum of χ². Stops once it is no better than `best`.
Score score(const Correspondences &matches, const Pose &pose, float chi2, float best) {
  constexpr int64_t kBetweenChecks = 4 * kLanes;
  const FloatPose live_from_reference(pose);
  Score result{0, 0};
  for (int64_t start = 0; start < matches.padded; start += kBetweenChecks) {
    Floats cost{};
    Ints inliers{};
    const int64_t end = std::min(start + kBetweenChecks, matches.padded);
    for (int64_t i = start; i < end; i += kLanes) {
      const Block block(matches, i, live_from_reference);
      const Ints inlier = block.usable & (block.chi2 < chi2);
      cost += (inlier ? block.chi2 : Floats{} + chi2) * load(&matches.valid[i]);
      inliers -= inlier;
    }
    result.cost += sum(cost);
    result.inliers += sum(inliers);
    if (result.cost >= best)
      break;
  }
  return result;
}

// Robust normal equations H δ = −g of the left perturbation of reference_from_live.
struct NormalEquations {
  double hessian[36];
  double gradient[6];
  double cost;
};

// Geman–McClure's ρ(χ²) = χ² / (1 + χ²/c²), c² = `scale`.
NormalEquations normal_equations(const Correspondences &matches, const Pose &pose, float scale) {
  const FloatPose live_from_reference(pose);
  const float *m = live_from_reference.m;
  Floats h[21] = {}, g[6] = {}, cost{};
  const float inverse_scale = 1 / scale;
  for (int64_t i = 0; i < matches.padded; i += kLanes) {
    const Block b(matches, i, live_from_reference);
    const Floats point[3] = {load(&matches.x[i]), load(&matches.y[i]), load(&matches.z[i])};
    const Floats zero{};
    const Floats shrink = 1.0f / (1.0f + b.chi2 * inverse_scale);
    const Floats weight = b.usable ? shrink * shrink : zero;
    cost += b.usable ? b.chi2 * shrink : load(&matches.valid[i]) * scale;
    Floats ju[6], jv[6], jd[6], along[6];
    for (int k = 0; k < 3; ++k) {
      ju[k] = -(b.along_u * m[k] + b.u_by_z * m[6 + k]);
      jv[k] = -(b.along_v * m[3 + k] + b.v_by_z * m[6 + k]);
      jd[k] = -(b.d_by_z * m[6 + k]);
    }
    for (Floats *j : {ju, jv, jd})
      for (int k = 0; k < 3; ++k)
        j[3 + k] = point[(k + 1) % 3] * j[(k + 2) % 3] - point[(k + 2) % 3] * j[(k + 1) % 3];
    const Floats wp = weight * b.wp, wd = weight * b.wd, wk = weight * b.kappa;
    for (int k = 0; k < 6; ++k)
      along[k] = b.wp * (b.ju * ju[k] + b.jv * jv[k]) + b.wd * b.jd * jd[k];
    int entry = 0;
    for (int row = 0; row < 6; ++row) {
      const Floats pu = wp * ju[row], pv = wp * jv[row], pd = wd * jd[row], pk = wk * along[row];
      g[row] += pu * b.ru + pv * b.rv + pd * b.rd - pk * b.hr;
      for (int column = 0; column <= row; ++column)
        h[entry++] += pu * ju[column] + pv * jv[column] + pd * jd[column] - pk * along[column];
    }
  }
  NormalEquations result;
  int entry = 0;
  for (int row = 0; row < 6; ++row) {
    result.gradient[row] = sum(g[row]);
    for (int column = 0; column <= row; ++column)
      result.hessian[6 * row + column] = result.hessian[6 * column + row] = sum(h[entry++]);
  }
  result.cost = sum(cost);
  return result;
}

// Levenberg–Marquardt. Returns the normal equations at the pose reached.
NormalEquations refine(const Correspondences &matches, Pose &pose, float scale, int iterations) {
  constexpr double kConverged = 1e-5; // relative fall of the cost that is no longer worth a step
  NormalEquations equations = normal_equations(matches, pose, scale);
  double damping = 1e-4;
  for (int i = 0; i < iterations; ++i) {
    double factor[36], step[6];
    std::copy(equations.hessian, equations.hessian + 36, factor);
    for (int k = 0; k < 6; ++k) {
      factor[7 * k] *= 1 + damping;
      step[k] = -equations.gradient[k];
    }
    if (!factorise(factor, 6))
      break;
    solve_factorised(factor, 6, step);
    const Pose moved = perturbed(pose, step);
    const NormalEquations there = normal_equations(matches, moved, scale);
    if (there.cost < equations.cost) {
      const bool converged = equations.cost - there.cost < kConverged * equations.cost;
      pose = moved;
      equations = there;
      damping = std::max(damping * 0.1, 1e-9);
      if (converged)
        break;
    } else {
      damping *= 10;
      if (damping > 1e4)
        break;
    }
  }
  return equations;
}

// Which pairs of matches keep their distance: |X_i − X_j| = |Y_i − Y_j| within what the depths
// allow. Wrong matches rarely do, so triples are drawn from this graph (Leordeanu & Hebert 2005;
// Chen et al., SC²-PCR, 2022), which leaves few hypotheses to score even at 90 % outliers.
class DistanceGraph {
public:
  DistanceGraph(const FrameView &reference, const FrameView &live,
                const std::vector<RowPair> &pairs, const MatchSettings &settings)
      : count_(static_cast<int>(pairs.size())), words_((count_ + 63) / 64),
        bits_(static_cast<size_t>(count_) * words_, 0) {
    std::vector<End> x, y;
    for (const RowPair &pair : pairs) {
      x.push_back(end_of(reference, pair.reference, settings));
      y.push_back(end_of(live, pair.live, settings));
    }
    const double gate2 = settings.gate_sigmas * settings.gate_sigmas;
    for (int i = 0; i < count_; ++i)
      for (int j = 0; j < i; ++j)
        if (keep_distance(x[i], x[j], y[i], y[j], gate2))
          join(i, j);
  }

  int degree(int i) const { return popcount(row(i), row(i)); }
  int common(int i, int j) const { return popcount(row(i), row(j)); }

  // The n-th common neighbour of i and j, counted from 0.
  int nth_common(int i, int j, int n) const {
    for (int word = 0;; ++word) {
      uint64_t bits = row(i)[word] & row(j)[word];
      const int here = __builtin_popcountll(bits);
      if (n >= here) {
        n -= here;
        continue;
      }
      for (; n > 0; --n)
        bits &= bits - 1;
      return 64 * word + __builtin_ctzll(bits);
    }
  }

  // The chance that a triple drawn by `draw` consists of members only.
  double chance(const std::vector<uint64_t> &members) const {
    double total = 0;
    for (int i = 0; i < count_; ++i)
      if (members[i / 64] >> (i % 64) & 1) {
        const int all = degree(i);
        const double share =
            all > 0 ? static_cast<double>(popcount(row(i), members.data())) / all : 0;
        total += share * share;
      }
    return total / count_;
  }

  int words() const { return words_; }

private:
  struct End {
    Vec3 point;
    double relative_sigma, lateral_variance;
  };

  static End end_of(const FrameView &frame, int32_t row, const MatchSettings &settings) {
    const Vec3 point = point_of(frame, row);
    const double lateral = pixel_sigma(frame, row, settings) * point[2] / frame.camera.fx;
    return {point, relative_depth_sigma(frame, row), lateral * lateral};
  }

  static bool keep_distance(const End &xi, const End &xj, const End &yi, const End &yj,
                            double gate2) {
    double squared[2], variance = 0;
    const End *ends[2][2] = {{&xi, &xj}, {&yi, &yj}};
    for (int side = 0; side < 2; ++side) {
      const End &a = *ends[side][0], &b = *ends[side][1];
      const Vec3 apart = a.point - b.point;
      squared[side] = dot(apart, apart);
      // Depth errors move the points along their rays, pixel errors across.
      const double da = dot(apart, a.point) * a.relative_sigma;
      const double db = dot(apart, b.point) * b.relative_sigma;
      variance += (da * da + db * db) / (squared[side] + 1e-6) + a.lateral_variance +
                  b.lateral_variance;
    }
    // (p − q)² ≤ g²σ² without a square root: p² + q² − g²σ² ≤ 2pq.
    const double left = squared[0] + squared[1] - gate2 * variance;
    return left <= 0 || left * left <= 4 * squared[0] * squared[1];
  }

  static int popcount_words(const uint64_t *a, const uint64_t *b, int words) {
    int bits = 0;
    for (int word = 0; word < words; ++word)
      bits += __builtin_popcountll(a[word] & b[word]);
    return bits;
  }
  int popcount(const uint64_t *a, const uint64_t *b) const { return popcount_words(a, b, words_); }
  const uint64_t *row(int i) const { return bits_.data() + static_cast<size_t>(i) * words_; }
  void join(int i, int j) {
    bits_[static_cast<size_t>(i) * words_ + j / 64] |= uint64_t{1} << (j % 64);
    bits_[static_cast<size_t>(j) * words_ + i / 64] |= uint64_t{1} << (i % 64);
  }

  int count_, words_;
  std::vector<uint64_t> bits_;
};

// Orthonormal axes spanned by three points; false where they lie nearly on a line.
bool axes_of(const Vec3 &a, const Vec3 &b, const Vec3 &c, Vec3 axes[3]) {
  constexpr double kLeastSine = 0.03;
  const Vec3 first = b - a, second = c - a;
  const Vec3 normal = cross(first, second);
  const double length = norm(first), area = norm(normal);
  if (!(area > kLeastSine * length * norm(second)) || !(length > 0))
    return false;
  axes[0] = (1 / length) * first;
  axes[1] = (1 / area) * normal;
  axes[2] = cross(axes[0], axes[1]);
  return true;
}

// The transform that carries triangle y (live) onto triangle x (reference).
bool align(const Vec3 x[3], const Vec3 y[3], Pose &reference_from_live) {
  Vec3 to[3], from[3];
  if (!axes_of(x[0], x[1], x[2], to) || !axes_of(y[0], y[1], y[2], from))
    return false;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) {
      double total = 0;
      for (int k = 0; k < 3; ++k)
        total += to[k][row] * from[k][column];
      reference_from_live.rotation[3 * row + column] = total;
    }
  const Vec3 x_centre = (1.0 / 3) * (x[0] + x[1] + x[2]), y_centre = (1.0 / 3) * (y[0] + y[1] + y[2]);
  reference_from_live.translation = x_centre - rotate(reference_from_live, y_centre);
  return true;
}

// Thresholds on χ² with three degrees of freedom, as multiples of the final one: a hypothesis from
// three points is judged loosely, since its own error adds to that of the matches.
constexpr float kLoose = 4;

class Consensus {
public:
  Consensus(const FrameView &reference, const FrameView &live, const std::vector<RowPair> &pairs,
            const MatchSettings &settings, uint64_t seed)
      : reference_(reference), live_(live), settings_(settings), random_(seed), pairs_(pairs),
        matches_(correspondences(reference, live, pairs, settings)) {
    order_.resize(pairs.size());
    for (size_t i = 0; i < order_.size(); ++i)
      order_[i] = static_cast<int32_t>(i);
    std::sort(order_.begin(), order_.end(), [&](int32_t a, int32_t b) {
      return pairs[a].distance < pairs[b].distance ||
             (pairs[a].distance == pairs[b].distance && a < b);
    });
    order_.resize(std::min<size_t>(order_.size(), kGraphSize));
  }

  PoseEstimate run(const RigidTransform *first_guess) {
    if (static_cast<int32_t>(pairs_.size()) >= std::max(settings_.min_consensus, 3)) {
      if (first_guess)
        consider(*first_guess);
      search();
    }
    return finish();
  }

private:
  // Triples come from at most this many matches, the most alike: enough to find the pose, and the
  // graph's cost grows with the square.
  static constexpr size_t kGraphSize = 256;

  void search() {
    std::vector<RowPair> drawn_from;
    for (const int32_t i : order_)
      drawn_from.push_back(pairs_[i]);
    const DistanceGraph graph(reference_, live_, drawn_from, settings_);
    const auto count = static_cast<uint32_t>(order_.size());
    double chance = chance_of_success(graph);
    int hypotheses = 0;
    for (int sample = 0; sample < settings_.max_samples && hypotheses < settings_.max_hypotheses;
         ++sample) {
      if (power(1 - chance, sample) < 1 - settings_.confidence)
        break;
      const int i = static_cast<int>(random_.below(count));
      const int neighbours = graph.degree(i);
      if (neighbours == 0)
        continue;
      const int j = graph.nth_common(i, i, static_cast<int>(random_.below(neighbours)));
      const int both = graph.common(i, j);
      // All of a consensus keep their distances from each other.
      if (both + 2 < settings_.min_consensus)
        continue;
      const int k = graph.nth_common(i, j, static_cast<int>(random_.below(both)));
      ++hypotheses;
      Pose pose;
      if (hypothesis({order_[i], order_[j], order_[k]}, pose) && consider(pose))
        chance = chance_of_success(graph);
    }
  }

  bool hypothesis(const std::array<int32_t, 3> &triple, Pose &pose) {
    Vec3 x[3], y[3];
    sample_.clear();
    for (int k = 0; k < 3; ++k) {
      const RowPair &pair = pairs_[triple[k]];
      x[k] = point_of(reference_, pair.reference);
      y[k] = point_of(live_, pair.live);
      sample_.add(matches_, triple[k]);
    }
    if (!align(x, y, pose))
      return false;
    // Rigid alignment trusts all coordinates alike; two steps on the residuals weigh them.
    sample_.pad();
    constexpr float kNoShrinking = 1e6;
    refine(sample_, pose, kNoShrinking, 2);
    return true;
  }

  // Keeps the pose if it is the best so far, after local optimisation (Chum et al. 2003).
  bool consider(Pose pose) {
    const auto loose = static_cast<float>(kLoose * settings_.chi2);
    Score found = score(matches_, pose, loose, best_.cost);
    if (found.cost >= best_.cost || found.inliers < 4)
      return false;
    Pose better = pose;
    refine(matches_, better, loose, 3);
    refine(matches_, better, static_cast<float>(settings_.chi2), 3);
    const Score optimised = score(matches_, better, loose, found.cost);
    if (optimised.cost < found.cost) {
      found = optimised;
      pose = better;
    }
    best_ = found;
    pose_ = pose;
    return true;
  }

  double chance_of_success(const DistanceGraph &graph) const {
    // A triple of inliers gives a good hypothesis about every other time: noise and degeneracy.
    constexpr double kGoodSample = 0.5;
    if (best_.inliers == 0)
      return 0;
    const std::vector<uint8_t> inlier = inliers(kLoose * settings_.chi2);
    std::vector<uint64_t> members(graph.words(), 0);
    for (size_t i = 0; i < order_.size(); ++i)
      if (inlier[order_[i]])
        members[i / 64] |= uint64_t{1} << (i % 64);
    return kGoodSample * graph.chance(members);
  }

  std::vector<uint8_t> inliers(double chi2) const {
    const FloatPose live_from_reference(pose_);
    std::vector<uint8_t> result(matches_.padded);
    for (int64_t i = 0; i < matches_.padded; i += kLanes) {
      const Block block(matches_, i, live_from_reference);
      const Ints inlier = block.usable & (block.chi2 < static_cast<float>(chi2));
      for (int lane = 0; lane < kLanes; ++lane)
        result[i + lane] = inlier[lane] != 0;
    }
    return result;
  }

  PoseEstimate finish() {
    PoseEstimate estimate;
    if (best_.inliers < settings_.min_consensus)
      return estimate;
    constexpr int kIterations = 10;
    const NormalEquations equations =
        refine(matches_, pose_, static_cast<float>(settings_.chi2), kIterations);
    const std::vector<uint8_t> agrees = inliers(settings_.chi2);
    for (size_t i = 0; i < pairs_.size(); ++i)
      if (agrees[i])
        estimate.inliers.push_back(pairs_[i]);
    double factor[36];
    std::copy(equations.hessian, equations.hessian + 36, factor);
    estimate.found = static_cast<int32_t>(estimate.inliers.size()) >= settings_.min_consensus &&
                     factorise(factor, 6);
    if (!estimate.found) {
      estimate.inliers.clear();
      return estimate;
    }
    invert_factorised(factor, 6, estimate.covariance.data());
    estimate.reference_from_live = pose_;
    return estimate;
  }

  const FrameView &reference_, &live_;
  const MatchSettings &settings_;
  Random random_;
  const std::vector<RowPair> &pairs_;
  Correspondences matches_;
  Correspondences sample_{live_.camera};
  std::vector<int32_t> order_;
  Pose pose_;
  Score best_;
};

} // namespace

PoseEstimate estimate_pose(const FrameView &reference, const FrameView &live,
                           const std::vector<RowPair> &pairs, const MatchSettings &settings,
                           uint64_t seed, const RigidTransform *first_guess) {
  return Consensus(reference, live, pairs, settings, seed).run(first_guess);
}

PoseEstimate attempt(const FrameView &reference, const FrameView &live,
                     const MatchSettings &settings, uint64_t seed, const Prediction *prediction) {
  std::vector<RowPair> pairs;
  if (prediction)
    match_near(reference, live, *prediction, settings, pairs);
  else
    match_all(reference, live, settings, pairs);
  PoseEstimate first = estimate_pose(reference, live, pairs, settings, seed,
                                     prediction ? &prediction->reference_from_live : nullptr);
  if (!first.found || !settings.second_pass)
    return first;
  const Prediction found{first.reference_from_live, first.covariance};
  match_near(reference, live, found, settings, pairs);
  MatchSettings no_search = settings;
  no_search.max_samples = 0;
  PoseEstimate second =
      estimate_pose(reference, live, pairs, no_search, seed, &first.reference_from_live);
  return second.inliers.size() >= first.inliers.size() ? second : first;
}

} // namespace engram::ENGRAM_ISA
