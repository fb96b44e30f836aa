#include "kernels/odometry.hpp"

#include <algorithm>
#include <cmath>

#include "kernels/doubt.hpp"
#include "kernels/pose.hpp"
#include "kernels/tracked_window.hpp"
#include "kernels/twist.hpp"

// Frames are matched to the last keyframe, not to the previous frame, so that errors do not add up
// while the camera rests or moves slowly. The motion between successive frames follows by
// composition. See engram.odometry.

namespace engram::ENGRAM_ISA {
namespace {

constexpr double kSecondsPerNs = 1e-9;
// Steps that determine the usual number of inliers and the usual interval.
constexpr size_t kUsualOf = 20;
// Frames are missing if one comes later than this many usual intervals after the last.
constexpr double kGapRatio = 1.5;
// A motion nearer than this to the last speed goes on as before.
constexpr double kSteadySigmas = 2;
// A robot that lost this share of its speed has stopped; a step vaguer than that tells no speed.
constexpr double kStoppedShare = 0.5;

void remember(std::vector<double> &values, double value) {
  if (values.size() == kUsualOf)
    values.erase(values.begin());
  values.push_back(value);
}

// Of at least one value, which are moved about.
template <class T> T median(std::vector<T> &values) {
  const auto middle = values.begin() + static_cast<int64_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  if (values.size() % 2 == 1)
    return *middle;
  return (*std::max_element(values.begin(), middle) + *middle) / 2;
}

double usual(std::vector<double> values, double unknown) {
  return values.empty() ? unknown : median(values);
}

double seconds_between(int64_t from_ns, int64_t to_ns) {
  return static_cast<double>(to_ns - from_ns) * kSecondsPerNs;
}

bool knows_speed(const OdometryTrack &track, const OdometrySettings &settings, double interval_s) {
  return track.velocity && interval_s > 0 && interval_s <= settings.max_prediction_s;
}

// By constant velocity, give or take so much.
Prediction by_speed(const OdometryTrack &track, const Tangent &velocity, double interval_s,
                    double sigma_m, double sigma_rad) {
  const RigidTransform &keyframe_from_prev = track.keyframe_from_prev;
  Tangent moved = velocity;
  for (double &entry : moved)
    entry *= interval_s;
  Covariance noise{};
  for (int i = 0; i < 6; ++i)
    noise[7 * i] = squared(i < 3 ? sigma_m : sigma_rad);
  return {compose(keyframe_from_prev, exponential(moved)),
          track.searched + carried(keyframe_from_prev, noise)};
}

// By constant velocity, or what is expected where that says nothing.
std::optional<Prediction> predict(const OdometryTrack &track, const OdometrySettings &settings,
                                  double interval_s, const ExpectedMotion *expected) {
  if (knows_speed(track, settings, interval_s)) {
    const double square = interval_s * interval_s;
    return by_speed(track, *track.velocity, interval_s, settings.acceleration_m_s2 * square,
                    settings.angular_acceleration_rad_s2 * square);
  }
  if (expected == nullptr)
    return std::nullopt;
  const RigidTransform &keyframe_from_prev = track.keyframe_from_prev;
  return Prediction{compose(keyframe_from_prev, expected->prev_from_curr),
                    track.searched + carried(keyframe_from_prev, expected->covariance)};
}

// The matcher refines in single precision: many small updates skew the rotation by 1e-6.
PoseEstimate attempted(const KeptFrame &key, const FrameView &live, const MatchSettings &match,
                       int64_t stamp_ns, const Prediction *prediction) {
  PoseEstimate found =
      attempt(key.view(), live, match, static_cast<uint64_t>(stamp_ns), prediction);
  if (found.found)
    found.reference_from_live = renormalised(found.reference_from_live);
  return found;
}

// How far a pose is from a prediction, in standard deviations of its least likely component.
double sigmas_away(const Prediction &prediction, const RigidTransform &pose) {
  const Tangent off = logarithm(compose(pose, inverse(prediction.reference_from_live)));
  double most = 0;
  for (int i = 0; i < 6; ++i)
    most = std::max(most, std::abs(off[i]) / std::sqrt(prediction.covariance[7 * i]));
  return most;
}

// Of a speed before, what is left in its direction.
double left_of(const Tangent &before, const Tangent &now) {
  const Vec3 was{before[0], before[1], before[2]};
  return dot(was, {now[0], now[1], now[2]}) / std::max(norm(was), 1e-9);
}

int32_t inliers_of(const PoseEstimate &match) {
  return match.found ? static_cast<int32_t>(match.inliers.size()) : 0;
}

class Step {
public:
  Step(OdometryState &state, const OdometrySettings &settings, const FrameView &live,
       int64_t stamp_ns, const ExpectedMotion *expected)
      : state_(state), settings_(settings), live_(live), stamp_ns_(stamp_ns),
        expected_(expected), track_(*state.track),
        interval_s_(seconds_between(track_.stamp_ns, stamp_ns)) {}

  OdometryMotion run() {
    const PoseEstimate match = matched();
    if (!believes(match)) {
      const double offset_px = track_.window.offset_px; // the camera's: kept when the chain breaks
      begin(state_, settings_, live_, stamp_ns_, offset_px);
      OdometryMotion none;
      none.status = match.found ? OdometryMotion::Status::too_few_matches
                                : OdometryMotion::Status::no_consensus;
      return none;
    }
    remember(state_.inliers, inliers_of(match));
    remember(state_.intervals_s, interval_s_);
    add_to_window(track_.window, live_, match, settings_);
    return advance(match, optimise_window(track_.window, match, settings_));
  }

  static void begin(OdometryState &state, const OdometrySettings &settings,
                    const FrameView &first, int64_t stamp_ns, double offset_px) {
    OdometryTrack track;
    track.window = begin_window(first, settings, offset_px);
    track.stamp_ns = stamp_ns;
    state.track = std::move(track);
  }

private:
  // To the keyframe; if that fails, or ends in an impossible stop, to the previous frame.
  PoseEstimate matched() {
    PoseEstimate match = matched_to_keyframe();
    const bool fails = inliers_of(match) < settings_.min_inliers || stops_at_once(match);
    if (fails && track_.window.newest) {
      keep_previous_as_keyframe();
      match = matched_to_keyframe();
    }
    return match;
  }

  // Guided; if that fails, unguided.
  PoseEstimate matched_to_keyframe() const {
    const KeptFrame &key = keyframe_of(track_.window);
    if (const auto prediction = predict(track_, settings_, interval_s_, expected_)) {
      PoseEstimate match =
          or_steady(key, attempted(key, live_, settings_.match, stamp_ns_, &*prediction));
      if (inliers_of(match) >= settings_.min_inliers)
        return match;
    }
    return attempted(key, live_, settings_.match, stamp_ns_, nullptr);
  }

  // A match, or that at the last speed where enough landmarks agree on it, too: drops on the lens
  // and the light of one's own lamps move along with the camera, and agree that nothing moves.
  PoseEstimate or_steady(const KeptFrame &key, PoseEstimate match) const {
    if (!match.found || !knows_speed(track_, settings_, interval_s_))
      return match;
    const Prediction steady =
        by_speed(track_, track_.stopped ? track_.believed->velocity : *track_.velocity,
                 interval_s_, settings_.steady_m, settings_.steady_rad);
    const double away = sigmas_away(steady, match.reference_from_live);
    if (away <= kSteadySigmas)
      return match;
    PoseEstimate again = attempted(key, live_, settings_.match, stamp_ns_, &steady);
    const double share = stops_at_once(match) ? settings_.braking_share : settings_.steady_share;
    const bool enough = inliers_of(again) >= settings_.min_inliers &&
                        inliers_of(again) >= share * inliers_of(match);
    return enough && sigmas_away(steady, again.reference_from_live) < away ? again : match;
  }

  // Whether enough landmarks agree on the motion; after a gap in time more are needed.
  bool believes(const PoseEstimate &match) const {
    const int32_t inliers = inliers_of(match);
    if (inliers < settings_.min_inliers || !is_gap())
      return inliers >= settings_.min_inliers;
    const double share = settings_.usual_share * usual(state_.inliers, HUGE_VAL);
    const double needed =
        std::min(std::max(share, static_cast<double>(settings_.min_inliers)),
                 static_cast<double>(settings_.unexpected_inliers));
    return inliers >= needed || (inliers >= settings_.plausible_inliers && explains(match));
  }

  // Whether frames are missing, judged by the camera's usual interval.
  bool is_gap() const {
    if (interval_s_ > 0 && interval_s_ <= settings_.max_prediction_s)
      return false;
    return !(interval_s_ > 0 && interval_s_ <= kGapRatio * usual(state_.intervals_s, 0));
  }

  // Whether the last speed, with acceleration or braking, explains the pose.
  bool explains(const PoseEstimate &match) const {
    if (!track_.velocity)
      return false;
    const Tangent moved =
        logarithm(compose(inverse(track_.keyframe_from_prev), match.reference_from_live));
    Vec3 changed;
    for (int i = 0; i < 3; ++i)
      changed[i] = moved[i] - (*track_.velocity)[i] * interval_s_;
    return norm(changed) <= 0.5 * settings_.acceleration_m_s2 * interval_s_ * interval_s_;
  }

  // Makes the frame the previous one.
  OdometryMotion advance(const PoseEstimate &match, const PlacedPose &keyframe_from_curr) {
    const RigidTransform prev_from_keyframe = inverse(track_.keyframe_from_prev);
    OdometryMotion motion;
    motion.status = OdometryMotion::Status::ok;
    motion.prev_from_curr = compose(prev_from_keyframe, keyframe_from_curr.pose);
    motion.covariance =
        carried(prev_from_keyframe, track_.covariance + keyframe_from_curr.covariance);
    // What calibration leaves is a share of the motion: one camera took both frames.
    const double left_m = settings_.match.calibration_share * norm(motion.prev_from_curr.translation);
    for (int axis = 0; axis < 3; ++axis)
      motion.covariance[7 * axis] += squared(left_m);
    motion.inliers = inliers_of(match);
    track_.velocity = velocity_of(motion.prev_from_curr);
    const bool stops = stops_at_once(motion.prev_from_curr);
    if (stops)
      allow_for_speed(motion);
    else
      believe(motion);
    track_.stopped = stops || (track_.stopped && track_.believed);
    track_.stamp_ns = stamp_ns_;
    track_.keyframe_from_prev = keyframe_from_curr.pose;
    track_.covariance = keyframe_from_curr.covariance;
    track_.searched = keyframe_from_curr.searched;
    if (stops) {
      // What it left in the window would make the next frames rest, too.
      track_.window = begin_window(live_, settings_, track_.window.offset_px);
      begin_at_previous();
    } else if (has_moved_on(match)) {
      keep_previous_as_keyframe();
    }
    return motion;
  }

  // A vague step leaves what was believed before, as long as that counts.
  void believe(const OdometryMotion &motion) {
    const double step_m = norm(motion.prev_from_curr.translation);
    double variance_m2 = 0;
    for (int axis = 0; axis < 3; ++axis)
      variance_m2 += motion.covariance[7 * axis];
    if (!track_.velocity || (track_.believed && !counts(*track_.believed)))
      track_.believed.reset();
    if (!track_.velocity || variance_m2 > squared(kStoppedShare * step_m))
      return;
    track_.believed = {*track_.velocity, step_m, stamp_ns_};
    track_.stopped = false;
  }

  bool counts(const BelievedSpeed &believed) const {
    return seconds_between(believed.stamp_ns, stamp_ns_) <= settings_.disbelief_s;
  }

  // Tangent per second; none in no time.
  std::optional<Tangent> velocity_of(const RigidTransform &prev_from_curr) const {
    if (interval_s_ <= 0)
      return std::nullopt;
    Tangent velocity = logarithm(prev_from_curr);
    for (double &entry : velocity)
      entry /= interval_s_;
    return velocity;
  }

  // The robot may have gone on at the last speed, too.
  void allow_for_speed(OdometryMotion &motion) const {
    const Vec3 &moved_m = motion.prev_from_curr.translation;
    Vec3 further_m;
    for (int i = 0; i < 3; ++i)
      further_m[i] = track_.believed->velocity[i] * interval_s_ - moved_m[i];
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 3; ++column)
        motion.covariance[6 * row + column] += further_m[row] * further_m[column];
  }

  bool stops_at_once(const PoseEstimate &match) const {
    return match.found &&
           stops_at_once(compose(inverse(track_.keyframe_from_prev), match.reference_from_live));
  }

  // Whether a step is, or goes on with, a stop faster than any robot brakes.
  bool stops_at_once(const RigidTransform &prev_from_curr) const {
    const auto velocity = velocity_of(prev_from_curr);
    if (!velocity || !track_.believed || !counts(*track_.believed))
      return false;
    const BelievedSpeed &believed = *track_.believed;
    // A stamp that is wrong makes a step fast, not long.
    const double was_m_s = std::min(left_of(believed.velocity, believed.velocity),
                                    believed.step_m / interval_s_);
    const double since_s = seconds_between(believed.stamp_ns, stamp_ns_);
    const double braked_m_s = track_.stopped ? 0 : settings_.braking_m_s2 * since_s;
    return was_m_s - left_of(believed.velocity, *velocity) >
           std::max(kStoppedShare * was_m_s, braked_m_s);
  }

  bool has_moved_on(const PoseEstimate &match) const {
    const KeptFrame &before = keyframe_of(track_.window);
    const auto fewer = std::min(static_cast<int64_t>(before.octaves.size()), live_.count);
    if (inliers_of(match) < settings_.keyframe_share * static_cast<double>(fewer))
      return true;
    std::vector<float> flow_px;
    for (const RowPair &pair : match.inliers) {
      const float *there = live_.pixels + 2 * pair.live;
      const float *here = before.pixels.data() + 2 * pair.reference;
      flow_px.push_back(std::max(std::abs(there[0] - here[0]), std::abs(there[1] - here[1])));
    }
    return median(flow_px) > static_cast<float>(settings_.keyframe_flow_px);
  }

  void keep_previous_as_keyframe() {
    keep_newest(track_.window, settings_);
    begin_at_previous();
  }

  // The previous frame is the keyframe now.
  void begin_at_previous() {
    track_.keyframe_from_prev = RigidTransform{};
    track_.covariance = {};
    track_.searched = {};
  }

  OdometryState &state_;
  const OdometrySettings &settings_;
  const FrameView &live_;
  const int64_t stamp_ns_;
  const ExpectedMotion *expected_;
  OdometryTrack &track_;
  const double interval_s_;
};

} // namespace

OdometryMotion odometry_step(OdometryState &state, const OdometrySettings &settings,
                             const FrameView &live, int64_t stamp_ns,
                             const ExpectedMotion *expected) {
  if (state.track)
    return Step(state, settings, live, stamp_ns, expected).run();
  Step::begin(state, settings, live, stamp_ns, 0);
  return {};
}

} // namespace engram::ENGRAM_ISA
