#include "kernels/pose.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "kernels/correspondences.hpp"
#include "kernels/distance_graph.hpp"
#include "kernels/doubt.hpp"
#include "kernels/matching.hpp"
#include "kernels/triangles.hpp"
#include "kernels/uncertainty.hpp"

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

Correspondences correspondences(const FrameView &reference, const FrameView &live,
                                const std::vector<RowPair> &pairs, const MatchSettings &settings,
                                OffsetsAre offsets) {
  Correspondences matches(live.camera);
  matches.reserve(pairs.size());
  for (const RowPair &pair : pairs) {
    const Vec3 x = point_of(reference, pair.reference), y = point_of(live, pair.live);
    // A reference pixel's error, brought to live pixels by the ratio of focal length and depth.
    const double magnification =
        live.camera.fx * x[2] / (reference.camera.fx * std::max(y[2], kNearest_m));
    const double own = pixel_sigma(live, pair.live, settings);
    const double other = magnification * pixel_sigma(reference, pair.reference, settings);
    const float *pixel = live.pixels + 2 * pair.live;
    matches.add(x, reference.disparity_px[pair.reference],
                {pixel[0], pixel[1], live.disparity_px[pair.live]}, own * own + other * other,
                disparity_variance(live, pair.live, settings, offsets),
                relative_depth_variance(reference, pair.reference, settings, offsets));
  }
  matches.pad();
  return matches;
}

struct Score {
  float cost = std::numeric_limits<float>::max();
  int32_t inliers = 0;
};

// MSAC (Torr & Zisserman 2000): the truncated sum of χ². Stops once it is no better than `best`.
Score score(const Correspondences &matches, const FloatPose &live_from_reference, float chi2,
            float best) {
  constexpr int64_t kBetweenChecks = 4 * kLanes;
  Score result{0, 0};
  for (int64_t start = 0; start < matches.padded; start += kBetweenChecks) {
    Floats cost(0);
    Ints inliers(0);
    const int64_t end = std::min(start + kBetweenChecks, matches.padded);
    for (int64_t i = start; i < end; i += kLanes) {
      const Block<kLanes> block(matches, i, live_from_reference);
      const Ints inlier = block.usable & (block.chi2 < chi2);
      cost += select(inlier, block.chi2, chi2) * load(&matches.valid[i]);
      inliers -= inlier;
    }
    result.cost += sum(cost);
    result.inliers += sum(inliers);
    if (result.cost >= best)
      break;
  }
  return result;
}

// Whether so many matches have a χ² below this.
bool agree(const Correspondences &matches, const FloatPose &live_from_reference, float chi2,
           int32_t wanted) {
  constexpr int64_t kBetweenChecks = 4 * kLanes;
  int32_t found = 0;
  for (int64_t start = 0; start < matches.padded && found < wanted; start += kBetweenChecks) {
    Ints inliers(0);
    const int64_t end = std::min(start + kBetweenChecks, matches.padded);
    for (int64_t i = start; i < end; i += kLanes) {
      const Block<kLanes> block(matches, i, live_from_reference);
      inliers -= block.usable & (block.chi2 < chi2);
    }
    found += sum(inliers);
  }
  return found >= wanted;
}

// What is estimated: the left perturbation of reference_from_live, and where asked for the offsets.
constexpr int kPose = 6, kPoseAndOffsets = 8;

struct Estimate {
  Pose pose;
  Offsets offsets;
};

// Information of the prior on (reference offset, live offset), both of mean zero. One camera has
// one offset, but for the little that it drifts.
struct OffsetPrior {
  double own = 0, cross = 0;

  // χ² of two offsets.
  double chi2(const Offsets &offsets) const {
    return own * (squared(offsets.reference) + squared(offsets.live)) +
           2 * cross * offsets.reference * offsets.live;
  }

  explicit OffsetPrior(const MatchSettings &settings) {
    const double spread = 1 / (settings.offset_sigma_px * settings.offset_sigma_px);
    const double tie =
        settings.same_camera ? 1 / (settings.offset_drift_px * settings.offset_drift_px) : 0;
    own = spread + tie;
    cross = -tie;
  }
};

// Robust normal equations H δ = −g.
template <int size> struct NormalEquations {
  double hessian[size * size];
  double gradient[size];
  double cost;
};

// The equations' sums, in lanes. By the pose, a residual's derivative is (a, x × a): a that by the
// translation, x the point in the reference. So the three residuals of a match, whose information
// is C⁻¹ = D⁻¹ − κ hhᵀ, come down to a symmetric 3×3 matrix M and a vector m:
//     H = (M, ([x]× M)ᵀ; [x]× M, −[x]× M [x]×),  g = (m, x × m).
template <int size, int lanes> struct Sums {
  typedef Pack<float, lanes> Floats;
  typedef Vec3Floats<lanes> Vector;

  // Where they stand: M (xx, yx, yy, zx, zy, zz); [x]× M, row-major; −[x]× M [x]×;
  // g; the cost; rows of the reference's and the live camera's offset; the offsets' own block.
  static constexpr int kMoving = 0, kMixed = 6, kTurning = 15, kGradient = 21,
                       kCost = kGradient + size, kByOffset = kCost + 1, kOffsets = kByOffset + 12,
                       kCount = size == kPose ? kByOffset : kOffsets + 3,
                       kPadded = (kCount + 3) / 4 * 4;

  Floats all[kPadded];

  void add(const Block<lanes> &b, const FloatPose &pose, Floats valid, float scale) {
    const float *r = pose.m;
    const Floats robust = 1.0f / (1.0f + b.chi2 / scale);
    const Floats weight = select(b.usable, robust * robust, 0.0f);
    all[kCost] += select(b.usable, b.chi2 * robust, valid * scale);
    Vector u, v, d, along; // a of each residual, and hᵀA
    for (int k = 0; k < 3; ++k) {
      u[k] = -(b.along_u * r[k] + b.u_by_z * r[6 + k]);
      v[k] = -(b.along_v * r[3 + k] + b.v_by_z * r[6 + k]);
      d[k] = -(b.d_by_z * r[6 + k]);
      along[k] = b.wp * (b.ju * u[k] + b.jv * v[k]) + b.wd * b.jd * d[k];
    }
    const Floats wp = weight * b.wp, wd = weight * b.wd, wk = weight * b.kappa;
    Floats matrix[6];
    Vector vector;
    int entry = 0;
    for (int row = 0; row < 3; ++row) {
      const Floats pu = wp * u[row], pv = wp * v[row], pd = wd * d[row], pk = wk * along[row];
      vector[row] = pu * b.ru + pv * b.rv + pd * b.rd - pk * b.hr;
      for (int column = 0; column <= row; ++column)
        matrix[entry++] = pu * u[column] + pv * v[column] + pd * d[column] - pk * along[column];
    }
    add_pose({b.x, b.y, b.z}, matrix, vector, all);
    if constexpr (size == kPoseAndOffsets)
      add_offsets(b, weight, d, along);
  }

  NormalEquations<size> equations() const {
    float totals[kPadded];
    for (int k = 0; k < kPadded; k += 4) {
      const FourFloats four = sums(all[k], all[k + 1], all[k + 2], all[k + 3]);
      std::memcpy(totals + k, &four, sizeof four);
    }
    NormalEquations<size> result;
    const auto set = [&](int row, int column, float total) {
      result.hessian[size * row + column] = result.hessian[size * column + row] = total;
    };
    int entry = 0;
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column <= row; ++column, ++entry) {
        set(row, column, totals[kMoving + entry]);
        set(3 + row, 3 + column, totals[kTurning + entry]);
      }
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 3; ++column)
        set(3 + row, column, totals[kMixed + 3 * row + column]);
    if constexpr (size == kPoseAndOffsets) {
      for (int column = 0; column < 6; ++column) {
        set(6, column, totals[kByOffset + column]);
        set(7, column, totals[kByOffset + 6 + column]);
      }
      set(6, 6, totals[kOffsets]), set(7, 6, totals[kOffsets + 1]);
      set(7, 7, totals[kOffsets + 2]);
    }
    for (int row = 0; row < size; ++row)
      result.gradient[row] = totals[kGradient + row];
    result.cost = totals[kCost];
    return result;
  }

private:
  static void add_pose(const Vector &x, const Floats matrix[6], const Vector &vector,
                       Floats *all) {
    const Vector turned = cross<lanes>(x, vector);
    const Vector columns[3] = {cross<lanes>(x, {matrix[0], matrix[1], matrix[3]}),
                                   cross<lanes>(x, {matrix[1], matrix[2], matrix[4]}),
                                   cross<lanes>(x, {matrix[3], matrix[4], matrix[5]})};
    int entry = 0;
    for (int row = 0; row < 3; ++row) {
      all[kGradient + row] += vector[row];
      all[kGradient + 3 + row] += turned[row];
      for (int column = 0; column < 3; ++column)
        all[kMixed + 3 * row + column] += columns[column][row];
      const Vector both = cross<lanes>(x, {columns[0][row], columns[1][row], columns[2][row]});
      for (int column = 0; column <= row; ++column, ++entry) {
        all[kMoving + entry] += matrix[entry];
        all[kTurning + entry] += both[column];
      }
    }
  }

  // The reference's offset moves the residuals as depth does, the live one's the disparity alone.
  void add_offsets(const Block<lanes> &b, Floats weight, const Vector &d, const Vector &along) {
    const Vector x = {b.x, b.y, b.z};
    const Floats reference = weight * b.by_offset * b.kept;
    const Floats wd = weight * b.wd, hd = b.wd * b.jd, pk = weight * b.kappa * hd;
    Vector by_reference, by_live;
    for (int k = 0; k < 3; ++k) {
      by_reference[k] = reference * along[k];
      by_live[k] = wd * d[k] - pk * along[k];
    }
    const Vector turned_reference = cross<lanes>(x, by_reference), turned_live = cross<lanes>(x, by_live);
    for (int k = 0; k < 3; ++k) {
      all[kByOffset + k] += by_reference[k];
      all[kByOffset + 3 + k] += turned_reference[k];
      all[kByOffset + 6 + k] += by_live[k];
      all[kByOffset + 9 + k] += turned_live[k];
    }
    all[kOffsets] += reference * b.by_offset * b.depth_information;
    all[kOffsets + 1] += reference * hd;
    all[kOffsets + 2] += wd - pk * hd;
    all[kGradient + 6] += reference * b.hr;
    all[kGradient + 7] += wd * b.rd - pk * b.hr;
  }
};

// Geman–McClure's ρ(χ²) = χ² / (1 + χ²/c²), c² = `scale`.
template <int size, int lanes>
NormalEquations<size> normal_equations(const Correspondences &matches, const Estimate &estimate,
                                       float scale) {
  const FloatPose live_from_reference(estimate.pose, estimate.offsets);
  Sums<size, lanes> sums{};
  const int64_t end = lanes == kLanes ? matches.padded : matches.count;
  for (int64_t i = 0; i < end; i += lanes)
    sums.add(Block<lanes>(matches, i, live_from_reference), live_from_reference,
             Pack<float, lanes>::load(&matches.valid[i]), scale);
  return sums.equations();
}

void add_prior(const OffsetPrior &prior, const Offsets &offsets,
               NormalEquations<kPoseAndOffsets> &equations) {
  double *h = equations.hessian, *g = equations.gradient;
  const double reference = prior.own * offsets.reference + prior.cross * offsets.live;
  const double live = prior.cross * offsets.reference + prior.own * offsets.live;
  h[6 * 8 + 6] += prior.own, h[7 * 8 + 7] += prior.own;
  h[6 * 8 + 7] += prior.cross, h[7 * 8 + 6] += prior.cross;
  g[6] += reference, g[7] += live;
  equations.cost += offsets.reference * reference + offsets.live * live;
}

template <int size, int lanes>
NormalEquations<size> equations_at(const Correspondences &matches, const Estimate &estimate,
                                   float scale, [[maybe_unused]] const OffsetPrior &prior) {
  auto equations = normal_equations<size, lanes>(matches, estimate, scale);
  if constexpr (size == kPoseAndOffsets)
    add_prior(prior, estimate.offsets, equations);
  return equations;
}

// Levenberg–Marquardt. Returns the normal equations at the estimate reached. Four lanes are enough
// for the three matches of a hypothesis; the other twelve would add zeros.
template <int size, int lanes = kLanes>
NormalEquations<size> refine(const Correspondences &matches, Estimate &estimate, float scale,
                             int iterations, const OffsetPrior &prior) {
  constexpr double kConverged = 1e-5; // relative fall of the cost that is no longer worth a step
  auto equations = equations_at<size, lanes>(matches, estimate, scale, prior);
  double damping = 1e-4;
  for (int i = 0; i < iterations; ++i) {
    double factor[size * size], step[size];
    std::copy(equations.hessian, equations.hessian + size * size, factor);
    for (int k = 0; k < size; ++k) {
      factor[(size + 1) * k] *= 1 + damping;
      step[k] = -equations.gradient[k];
    }
    if (!factorise(factor, size))
      break;
    solve_factorised(factor, size, step);
    Estimate moved{perturbed(estimate.pose, step), estimate.offsets};
    if constexpr (size == kPoseAndOffsets) {
      moved.offsets.reference += step[6];
      moved.offsets.live += step[7];
    }
    const auto there = equations_at<size, lanes>(matches, moved, scale, prior);
    if (there.cost < equations.cost) {
      const bool converged = equations.cost - there.cost < kConverged * equations.cost;
      estimate = moved;
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

std::vector<uint8_t> inliers(const Correspondences &matches, const Estimate &estimate,
                             double chi2) {
  const FloatPose live_from_reference(estimate.pose, estimate.offsets);
  std::vector<uint8_t> result(matches.padded);
  for (int64_t i = 0; i < matches.padded; i += kLanes) {
    const Block<kLanes> block(matches, i, live_from_reference);
    const Ints inlier = block.usable & (block.chi2 < static_cast<float>(chi2));
    for (int lane = 0; lane < kLanes; ++lane)
      result[i + lane] = inlier[lane] != 0;
  }
  return result;
}

constexpr int kIterations = 8; // Newton's method needs three or four from a good start

// Estimates pose and offsets from all matches, starting close by, and who agrees with them.
PoseEstimate settle(const FrameView &reference, const FrameView &live,
                    const std::vector<RowPair> &pairs, const MatchSettings &settings,
                    Estimate estimate) {
  const Correspondences matches =
      correspondences(reference, live, pairs, settings, OffsetsAre::estimated);
  const OffsetPrior prior(settings);
  const auto equations = refine<kPoseAndOffsets>(
      matches, estimate, static_cast<float>(settings.chi2), kIterations, prior);
  const std::vector<uint8_t> agrees = inliers(matches, estimate, settings.chi2);
  PoseEstimate result;
  for (size_t i = 0; i < pairs.size(); ++i)
    if (agrees[i])
      result.inliers.push_back(pairs[i]);
  double factor[64], covariance[64];
  std::copy(equations.hessian, equations.hessian + 64, factor);
  result.found = static_cast<int32_t>(result.inliers.size()) >= settings.min_consensus &&
                 estimate.pose.rotation[8] >= settings.max_view_angle_cosine &&
                 factorise(factor, kPoseAndOffsets);
  if (!result.found) {
    result.inliers.clear();
    return result;
  }
  invert_factorised(factor, kPoseAndOffsets, covariance);
  const auto inliers_found = static_cast<double>(result.inliers.size());
  Covariance by_residuals;
  for (int row = 0; row < 6; ++row)
    for (int column = 0; column < 6; ++column)
      by_residuals[6 * row + column] = covariance[8 * row + column];
  result.searched = searched(by_residuals, inliers_found, settings);
  // Among far landmarks a pose that is metres off fits as well, with offsets that no camera has.
  const double growth = growth_of_few(settings.few_inliers, inliers_found) +
                        squared(settings.offset_doubt * prior.chi2(estimate.offsets));
  result.covariance = doubted(by_residuals, growth, inliers_found,
                              estimate.pose.translation, settings);
  result.reference_from_live = estimate.pose;
  return result;
}

// Thresholds on χ² with three degrees of freedom, as multiples of the final one: a hypothesis from
// three points is judged loosely, since its own error adds to that of the matches.
constexpr float kLoose = 4;
constexpr float kLooser = 16; // of a triangle that was aligned, but not refined

class Consensus {
public:
  Consensus(const FrameView &reference, const FrameView &live, const std::vector<RowPair> &pairs,
            const MatchSettings &settings, uint64_t seed)
      : reference_(reference), live_(live), settings_(settings), random_(seed), pairs_(pairs),
        prior_(settings),
        matches_(correspondences(reference, live, pairs, settings, OffsetsAre::noise)) {
    // By distance, in the order of the pairs where it is equal.
    std::array<int32_t, 258> starts{};
    for (const RowPair &pair : pairs)
      ++starts[pair.distance + 1];
    for (size_t distance = 1; distance < starts.size(); ++distance)
      starts[distance] += starts[distance - 1];
    order_.resize(pairs.size());
    for (size_t i = 0; i < pairs.size(); ++i)
      order_[starts[pairs[i].distance]++] = static_cast<int32_t>(i);
    order_.resize(std::min<size_t>(order_.size(), kGraphSize));
  }

  // Searches for the pose that most matches agree on, and settles it.
  PoseEstimate run(const RigidTransform *first_guess) {
    if (static_cast<int32_t>(pairs_.size()) < std::max(settings_.min_consensus, 3))
      return {};
    if (first_guess)
      consider(*first_guess);
    if (!most_agree())
      search();
    if (best_.inliers < settings_.min_consensus)
      return {};
    Estimate estimate{pose_, {}};
    // The pose alone first: with the offsets free, a start far off could bend them instead.
    refine<kPose>(matches_, estimate, static_cast<float>(settings_.chi2), kIterations, prior_);
    return settle(reference_, live_, pairs_, settings_, estimate);
  }

private:
  // Triples come from at most this many matches, the most alike: enough to find the pose, and the
  // graph's cost grows with the square.
  static constexpr size_t kGraphSize = 256;

  // No other pose can have more matches than one that most of them agree on; what it lacks in
  // precision, refinement adds.
  bool most_agree() const {
    return best_.inliers >= settings_.min_consensus &&
           2 * best_.inliers > static_cast<int32_t>(pairs_.size());
  }

  // Every edge of the graph in scattered order, then again with other third matches, until a pose
  // is good enough or the samples are used up.
  void search() {
    std::vector<RowPair> drawn_from;
    drawn_from.reserve(order_.size());
    for (const int32_t i : order_)
      drawn_from.push_back(pairs_[i]);
    const DistanceGraph graph(reference_, live_, drawn_from, settings_);
    // All of a consensus keep their distances from each other.
    const auto edges = graph.edges(std::max(settings_.min_consensus - 2, 1));
    if (edges.empty())
      return;
    const auto count = static_cast<uint32_t>(edges.size());
    const uint32_t first = random_.below(count), step = scattering_step(count);
    double chance = chance_of_success(graph);
    uint32_t at = first;
    for (int sample = 0; sample < settings_.max_samples; sample += kLanes) {
      if (chance > 0 && power(1 - chance, sample) < 1 - settings_.confidence)
        return;
      std::array<int32_t, 3> triples[kLanes];
      uint32_t worth = 0;
      for (int lane = 0; lane < kLanes; ++lane) {
        const auto &[i, j, common] = edges[at];
        const int k = graph.nth_common(i, j, static_cast<int>(random_.below(common)));
        triples[lane] = {order_[i], order_[j], order_[k]};
        // Who follows a triple keeps the distance from all of it.
        worth |= static_cast<uint32_t>(3 + graph.common(i, j, k) >= settings_.min_followers) << lane;
        at = at + step < count ? at + step : at + step - count;
      }
      if (worth != 0 && tried(triples, worth))
        chance = chance_of_success(graph);
      if (most_agree() || hypotheses_ >= settings_.max_hypotheses)
        return;
    }
  }

  // A step around a circle of so many places that comes to each before it comes to one again.
  static uint32_t scattering_step(uint32_t count) {
    const auto coprime = [count](uint32_t step) {
      uint32_t a = count, b = step;
      while (b != 0)
        b = std::exchange(a, b) % b;
      return a == 1;
    };
    auto step = static_cast<uint32_t>(0.618 * count) | 1;
    while (step < count && !coprime(step))
      ++step;
    return step < count ? step : 1;
  }

  // Tries those of sixteen triples that are worth it. Returns whether one gave the best pose so far.
  bool tried(const std::array<int32_t, 3> (&triples)[kLanes], uint32_t worth) {
    Triangles x, y;
    for (int lane = 0; lane < kLanes; ++lane)
      for (int k = 0; k < 3; ++k) {
        const RowPair &pair = pairs_[triples[lane][k]];
        x.set(lane, k, reference_.points_in_cam + 3 * pair.reference);
        y.set(lane, k, live_.points_in_cam + 3 * pair.live);
      }
    const TrianglePoses aligned(x, y, settings_.max_view_angle_cosine);
    bool better = false;
    for (uint32_t bits = bits_of(aligned.valid) & worth; bits != 0; bits &= bits - 1) {
      const int lane = __builtin_ctz(bits);
      if (!is_followed(aligned.pose(lane)))
        continue;
      ++hypotheses_;
      Pose pose;
      if (!hypothesis(triples[lane], pose) || !consider(pose))
        continue;
      better = true;
      if (most_agree())
        break;
    }
    return better;
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
    Estimate estimate{pose, {}};
    refine<kPose, 4>(sample_, estimate, kNoShrinking, 2, prior_);
    pose = estimate.pose;
    return true;
  }

  // Whether enough matches follow an aligned triangle, judged more loosely still: its three
  // always do, and what nobody else follows is not worth refining.
  bool is_followed(const FloatPose &live_from_reference) const {
    const auto chi2 = static_cast<float>(kLooser * settings_.chi2);
    return agree(matches_, live_from_reference, chi2, settings_.min_followers);
  }

  // Keeps the pose if it is the best so far, after local optimisation (Chum et al. 2003).
  bool consider(Pose pose) {
    const auto loose = static_cast<float>(kLoose * settings_.chi2);
    Score found = score(matches_, FloatPose(pose), loose, best_.cost);
    if (found.cost >= best_.cost || found.inliers < 4)
      return false;
    Estimate better{pose, {}};
    refine<kPose>(matches_, better, loose, 3, prior_);
    refine<kPose>(matches_, better, static_cast<float>(settings_.chi2), 3, prior_);
    const Score optimised = score(matches_, FloatPose(better.pose), loose, found.cost);
    if (optimised.cost < found.cost) {
      found = optimised;
      pose = better.pose;
    }
    best_ = found;
    pose_ = pose;
    return true;
  }

  double chance_of_success(const DistanceGraph &graph) const {
    // A triple of inliers gives a good hypothesis about every fourth time: noise and degeneracy.
    constexpr double kGoodSample = 0.25;
    if (best_.inliers == 0)
      return 0;
    const std::vector<uint8_t> inlier =
        inliers(matches_, {pose_, {}}, kLoose * settings_.chi2);
    std::vector<uint64_t> members(graph.words(), 0);
    for (size_t i = 0; i < order_.size(); ++i)
      if (inlier[order_[i]])
        members[i / 64] |= uint64_t{1} << (i % 64);
    return kGoodSample * graph.chance(members);
  }

  const FrameView &reference_, &live_;
  const MatchSettings &settings_;
  Random random_;
  const std::vector<RowPair> &pairs_;
  OffsetPrior prior_;
  Correspondences matches_;
  Correspondences sample_{live_.camera};
  std::vector<int32_t> order_;
  Pose pose_;
  Score best_;
  int hypotheses_ = 0;
};

} // namespace

PoseEstimate estimate_pose(const FrameView &reference, const FrameView &live,
                           const std::vector<RowPair> &pairs, const MatchSettings &settings,
                           uint64_t seed, const RigidTransform *first_guess) {
  return Consensus(reference, live, pairs, settings, seed).run(first_guess);
}

namespace {

// All that match near the pose found, and the pose by them.
PoseEstimate second_pass(const FrameView &reference, const FrameView &live,
                         const MatchSettings &settings, const PoseEstimate &first) {
  std::vector<RowPair> pairs;
  const Prediction found{first.reference_from_live, first.searched};
  match_near(reference, live, found, settings, pairs);
  return settle(reference, live, pairs, settings, {first.reference_from_live, {}});
}

// An attempt, and what came of a glance at a part of the reference's landmarks.
struct Glanced {
  const FrameView &reference, &live;
  const MatchSettings &settings;
  uint64_t seed;
  PoseEstimate whole;
};

// Where a part of the landmarks agrees clearly, their pose guides the search for all of them.
bool agree_clearly(void *state, const std::vector<RowPair> &pairs) {
  auto &glanced = *static_cast<Glanced *>(state);
  const MatchSettings &settings = glanced.settings;
  MatchSettings few = settings;
  few.max_samples = std::min(settings.max_samples, settings.glance_samples);
  few.min_consensus = std::max(settings.min_consensus, settings.glance_consensus);
  const PoseEstimate first =
      estimate_pose(glanced.reference, glanced.live, pairs, few, glanced.seed, nullptr);
  if (!first.found)
    return false;
  glanced.whole = second_pass(glanced.reference, glanced.live, settings, first);
  return static_cast<int32_t>(glanced.whole.inliers.size()) >= settings.glance_inliers;
}

} // namespace

PoseEstimate attempt(const FrameView &reference, const FrameView &live,
                     const MatchSettings &settings, uint64_t seed, const Prediction *prediction) {
  std::vector<RowPair> pairs;
  Glanced glanced{reference, live, settings, seed, {}};
  const Glance glance{&glanced, agree_clearly};
  if (prediction)
    match_near(reference, live, *prediction, settings, pairs);
  else if (match_all(reference, live, settings, pairs, settings.second_pass ? &glance : nullptr))
    return glanced.whole;
  const PoseEstimate first =
      estimate_pose(reference, live, pairs, settings, seed,
                    prediction ? &prediction->reference_from_live : nullptr);
  if (!first.found || !settings.second_pass)
    return first;
  const PoseEstimate second = second_pass(reference, live, settings, first);
  return second.inliers.size() >= first.inliers.size() ? second : first;
}

} // namespace engram::ENGRAM_ISA
