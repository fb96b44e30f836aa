#include "kernels/matching.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <exception>
#include <optional>
#include <tuple>
#include <vector>

#include "bindings/features.hpp"
#include "bindings/transforms.hpp"
#include "kernels/pose.hpp"
#include "work_threads.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace engram;

namespace {

auto rows_to_numpy(const std::vector<RowPair> &pairs) {
  std::vector<int32_t> reference, live;
  for (const RowPair &pair : pairs) {
    reference.push_back(pair.reference);
    live.push_back(pair.live);
  }
  const size_t count = pairs.size();
  return nb::make_tuple(to_numpy(std::move(reference), {count}),
                        to_numpy(std::move(live), {count}));
}

// (reference_from_live (4, 4), covariance (6, 6), reference rows, live rows), or None.
nb::object to_python(const PoseEstimate &estimate) {
  if (!estimate.found)
    return nb::none();
  const auto rows = rows_to_numpy(estimate.inliers);
  std::vector<double> matrix;
  append_matrix(estimate.reference_from_live, matrix);
  std::vector<double> covariance(estimate.covariance.begin(), estimate.covariance.end());
  return nb::make_tuple(to_numpy(std::move(matrix), {4, 4}),
                        to_numpy(std::move(covariance), {6, 6}), rows[0], rows[1]);
}

std::optional<Prediction> prediction_of(const std::optional<Matrix> &predicted,
                                        const std::optional<Matrix> &covariance) {
  if (!predicted)
    return std::nullopt;
  if (!covariance)
    throw nb::value_error("a predicted transform needs its covariance");
  check_shape(*covariance, 6, 6, "a covariance must have shape (6, 6)");
  Prediction prediction{rigid(*predicted), {}};
  std::copy(covariance->data(), covariance->data() + 36, prediction.covariance.begin());
  return prediction;
}

void check_comparable(const Features &reference, const Features &live) {
  common_width(reference.descriptors, live.descriptors);
}

nb::object match_rows(const Features &reference, const Features &live,
                      const MatchSettings &settings, std::optional<Matrix> predicted,
                      std::optional<Matrix> covariance) {
  check_comparable(reference, live);
  const auto prediction = prediction_of(predicted, covariance);
  const FrameView a = reference.view(), b = live.view();
  std::vector<RowPair> pairs;
  {
    nb::gil_scoped_release unlocked;
    if (prediction)
      ENGRAM_CALL(match_near, a, b, *prediction, settings, pairs);
    else
      ENGRAM_CALL(match_all, a, b, settings, pairs, nullptr);
  }
  return rows_to_numpy(pairs);
}

nb::object estimate_pose(const Features &reference, const Features &live,
                         const Input<int32_t, 1> &reference_rows,
                         const Input<int32_t, 1> &live_rows, const MatchSettings &settings,
                         uint64_t seed) {
  if (reference_rows.shape(0) != live_rows.shape(0))
    throw nb::value_error("as many reference rows as live rows are needed");
  const FrameView a = reference.view(), b = live.view();
  std::vector<RowPair> pairs;
  for (size_t i = 0; i < live_rows.shape(0); ++i) {
    const RowPair pair{reference_rows.data()[i], live_rows.data()[i], 0};
    if (pair.reference < 0 || pair.reference >= a.count || pair.live < 0 || pair.live >= b.count)
      throw nb::index_error("a row lies outside its frame's landmarks");
    pairs.push_back(pair);
  }
  PoseEstimate estimate;
  {
    nb::gil_scoped_release unlocked;
    estimate = ENGRAM_CALL(estimate_pose, a, b, pairs, settings, seed, nullptr);
  }
  return to_python(estimate);
}

// One attempt: what it compares, and what came of it. Its arrays belong to the caller.
struct Attempt {
  FrameView reference;
  MatchSettings settings;
  uint64_t seed;
  std::optional<Prediction> prediction;
  PoseEstimate estimate{};
  std::exception_ptr error{};

  void make(const FrameView &live) {
    try {
      estimate = ENGRAM_CALL(attempt, reference, live, settings, seed,
                             prediction ? &*prediction : nullptr);
    } catch (...) {
      error = std::current_exception();
    }
  }
};

// (reference, settings, seed, predicted, covariance); the last two may be None.
using AttemptArguments = std::tuple<const Features *, const MatchSettings *, uint64_t,
                                    std::optional<Matrix>, std::optional<Matrix>>;

nb::list attempt(const Features &live, const std::vector<AttemptArguments> &asked,
                 WorkThreads *threads) {
  std::vector<Attempt> attempts;
  for (const auto &[reference, settings, seed, predicted, covariance] : asked) {
    check_comparable(*reference, live);
    attempts.push_back(
        {reference->view(), *settings, seed, prediction_of(predicted, covariance)});
  }
  const FrameView view = live.view();
  std::vector<WorkThreads::Job> jobs;
  for (Attempt &one : attempts)
    jobs.push_back([&one, &view] { one.make(view); });
  {
    nb::gil_scoped_release unlocked;
    if (threads)
      threads->run(jobs);
    else
      for (const WorkThreads::Job &job : jobs)
        job();
  }
  nb::list found;
  for (const Attempt &one : attempts) {
    if (one.error)
      std::rethrow_exception(one.error);
    found.append(to_python(one.estimate));
  }
  return found;
}

} // namespace

void bind_matching(nb::module_ &module) {
  nb::class_<MatchSettings>(module, "MatchSettings",
                            "Settings of matching; see `engram.frontend.matching.MatcherConfig`.")
      .def(nb::init<>())
      .def_rw("max_distance", &MatchSettings::max_distance)
      .def_rw("max_guided_distance", &MatchSettings::max_guided_distance)
      .def_rw("ratio", &MatchSettings::ratio)
      .def_rw("guided_ratio", &MatchSettings::guided_ratio)
      .def_rw("same_corner_px", &MatchSettings::same_corner_px)
      .def_rw("octave_scale", &MatchSettings::octave_scale)
      .def_rw("patch_ratio", &MatchSettings::patch_ratio)
      .def_rw("pixel_sigma_px", &MatchSettings::pixel_sigma_px)
      .def_rw("disparity_sigma_px", &MatchSettings::disparity_sigma_px)
      .def_rw("offset_sigma_px", &MatchSettings::offset_sigma_px)
      .def_rw("offset_drift_px", &MatchSettings::offset_drift_px)
      .def_rw("gate_sigmas", &MatchSettings::gate_sigmas)
      .def_rw("max_radius_px", &MatchSettings::max_radius_px)
      .def_rw("chi2", &MatchSettings::chi2)
      .def_rw("independent_landmarks", &MatchSettings::independent_landmarks)
      .def_rw("few_inliers", &MatchSettings::few_inliers)
      .def_rw("displaced_m", &MatchSettings::displaced_m)
      .def_rw("offset_doubt", &MatchSettings::offset_doubt)
      .def_rw("calibration_share", &MatchSettings::calibration_share)
      .def_rw("calibration_m", &MatchSettings::calibration_m)
      .def_rw("calibration_rad", &MatchSettings::calibration_rad)
      .def_rw("min_consensus", &MatchSettings::min_consensus)
      .def_rw("max_samples", &MatchSettings::max_samples)
      .def_rw("max_hypotheses", &MatchSettings::max_hypotheses)
      .def_rw("min_followers", &MatchSettings::min_followers)
      .def_rw("glance_share", &MatchSettings::glance_share)
      .def_rw("glance_samples", &MatchSettings::glance_samples)
      .def_rw("glance_consensus", &MatchSettings::glance_consensus)
      .def_rw("glance_inliers", &MatchSettings::glance_inliers)
      .def_rw("confidence", &MatchSettings::confidence)
      .def_rw("max_view_angle_cosine", &MatchSettings::max_view_angle_cosine)
      .def_rw("second_pass", &MatchSettings::second_pass)
      .def_rw("same_camera", &MatchSettings::same_camera);
  nb::class_<Features>(module, "Features", "The landmarks of a frame, checked for shape.")
      .def(nb::init<Input<float, 2>, Input<float, 1>, Input<float, 1>, Input<float, 2>,
                    Descriptors, Input<uint8_t, 1>, std::array<double, 5>>(),
           "pixels"_a, "disparity_px"_a, "disparity_sigma_px"_a, "points_in_cam"_a,
           "descriptors"_a, "octaves"_a, "camera"_a);
  module.def("match_rows", &match_rows, "reference"_a, "live"_a, "settings"_a,
             "predicted"_a = nb::none(), "covariance"_a = nb::none(),
             "Rows of the landmarks that look alike: (reference rows, live rows), (K,) int32. "
             "Near their predicted places where reference_from_live (4, 4) and its covariance "
             "(6, 6) are given.");
  module.def("estimate_pose", &estimate_pose, "reference"_a, "live"_a, "reference_rows"_a,
             "live_rows"_a, "settings"_a, "seed"_a,
             "(reference_from_live (4, 4), covariance (6, 6), reference rows, live rows of the "
             "inliers), or None where too few rows agree on a pose.");
  nb::class_<WorkThreads>(module, "WorkThreads",
                          "Threads that make attempts beside the caller's; started when needed.")
      .def(nb::init<int>(), "others"_a);
  module.def("attempt", &attempt, "live"_a, "attempts"_a, "threads"_a = nb::none(),
             "For each (reference, settings, seed, predicted, covariance) `match_rows` and "
             "`estimate_pose` in one, with a second pass guided by what the first one found; same "
             "result as `estimate_pose`. Side by side where threads are given.");
}
