#include "kernels/odometry.hpp"

#include <nanobind/stl/optional.h>

#include "bindings/features.hpp"
#include "bindings/transforms.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace engram;

namespace {

// An odometry with all that it remembers. One thread at a time may step it.
struct Odometry {
  OdometrySettings settings;
  OdometryState state;

  explicit Odometry(const OdometrySettings &settings) : settings(settings) {
    if (settings.window_frames < 2 || settings.window_landmarks < 1 ||
        settings.window_iterations < 0 || !(settings.window_offset_sigma_px > 0) ||
        !(settings.window_pixel_sigma_px > 0) || !(settings.window_disparity_sigma_px > 0))
      throw nb::value_error("odometry: a window of at least two frames and one landmark is needed, "
                            "and offset_sigma_px, pixel_sigma_px and disparity_sigma_px > 0");
    // An estimate from fewer has no median and no covariance.
    if (settings.min_inliers < 1)
      throw nb::value_error("odometry: min_inliers must be at least 1");
  }

  nb::object step(const Features &live, int64_t stamp_ns, std::optional<Matrix> expected,
                  std::optional<Matrix> covariance) {
    std::optional<ExpectedMotion> motion;
    if (expected.has_value() != covariance.has_value())
      throw nb::value_error("an expected motion and its covariance are given together");
    if (expected) {
      check_shape(*covariance, 6, 6, "a covariance must have shape (6, 6)");
      motion.emplace();
      motion->prev_from_curr = rigid(*expected);
      std::copy(covariance->data(), covariance->data() + 36, motion->covariance.begin());
    }
    const FrameView view = live.view();
    check_same_kind(view);
    OdometryMotion found;
    {
      nb::gil_scoped_release unlocked;
      found = ENGRAM_CALL(odometry_step, state, settings, view, stamp_ns,
                          motion ? &*motion : nullptr);
    }
    const auto status = static_cast<int32_t>(found.status);
    if (found.status != OdometryMotion::Status::ok)
      return nb::make_tuple(status, nb::none(), nb::none(), nb::none(), 0);
    const auto &pose = found.prev_from_curr;
    std::vector<double> rotation(pose.rotation.begin(), pose.rotation.end());
    std::vector<double> translation(pose.translation.begin(), pose.translation.end());
    std::vector<double> spread(found.covariance.begin(), found.covariance.end());
    return nb::make_tuple(status, to_numpy(std::move(rotation), {3, 3}),
                          to_numpy(std::move(translation), {3}),
                          to_numpy(std::move(spread), {6, 6}), found.inliers);
  }

  size_t tracks() const {
    return state.track ? static_cast<size_t>(state.track->window.tracks) : 0;
  }
  double offset_px() const { return state.track ? state.track->window.offset_px : 0; }

private:
  void check_same_kind(const FrameView &live) const {
    if (state.track && state.track->window.keyframes.back().width != live.width)
      throw nb::value_error("odometry: the descriptors' width changed within a drive");
  }
};

} // namespace

void bind_odometry(nb::module_ &module) {
  nb::class_<OdometrySettings>(module, "OdometrySettings",
                               "See `engram.odometry.odometry.OdometryConfig` and `WindowConfig`.")
      .def(nb::init<>())
      .def_rw("match", &OdometrySettings::match)
      .def_rw("window_frames", &OdometrySettings::window_frames)
      .def_rw("window_landmarks", &OdometrySettings::window_landmarks)
      .def_rw("window_iterations", &OdometrySettings::window_iterations)
      .def_rw("window_offset_sigma_px", &OdometrySettings::window_offset_sigma_px)
      .def_rw("window_pixel_sigma_px", &OdometrySettings::window_pixel_sigma_px)
      .def_rw("window_disparity_sigma_px", &OdometrySettings::window_disparity_sigma_px)
      .def_rw("min_inliers", &OdometrySettings::min_inliers)
      .def_rw("unexpected_inliers", &OdometrySettings::unexpected_inliers)
      .def_rw("plausible_inliers", &OdometrySettings::plausible_inliers)
      .def_rw("few_inliers", &OdometrySettings::few_inliers)
      .def_rw("usual_share", &OdometrySettings::usual_share)
      .def_rw("acceleration_m_s2", &OdometrySettings::acceleration_m_s2)
      .def_rw("angular_acceleration_rad_s2", &OdometrySettings::angular_acceleration_rad_s2)
      .def_rw("max_prediction_s", &OdometrySettings::max_prediction_s)
      .def_rw("steady_m", &OdometrySettings::steady_m)
      .def_rw("steady_rad", &OdometrySettings::steady_rad)
      .def_rw("steady_share", &OdometrySettings::steady_share)
      .def_rw("braking_m_s2", &OdometrySettings::braking_m_s2)
      .def_rw("braking_share", &OdometrySettings::braking_share)
      .def_rw("disbelief_s", &OdometrySettings::disbelief_s)
      .def_rw("keyframe_flow_px", &OdometrySettings::keyframe_flow_px)
      .def_rw("keyframe_share", &OdometrySettings::keyframe_share);
  nb::class_<Odometry>(module, "Odometry", "Visual odometry of one camera, frame by frame.")
      .def(nb::init<const OdometrySettings &>(), "settings"_a)
      .def("step", &Odometry::step, "live"_a, "stamp_ns"_a, "expected"_a = nb::none(),
           "covariance"_a = nb::none(),
           "(0, None, None, None, 0) at the first frame; (1, rotation (3, 3), translation (3,), "
           "covariance (6, 6), inliers) of prev_from_curr; 2 where too few landmarks agree on a "
           "motion, 3 where none do. `expected` is prev_from_curr (4, 4) by other sensors.")
      .def_prop_ro("tracks", &Odometry::tracks, "Landmarks that the window's frames share.")
      .def_prop_ro("offset_px", &Odometry::offset_px,
                   "Estimated excess of the camera's disparities.");
}
