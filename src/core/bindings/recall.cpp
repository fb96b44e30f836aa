#include "kernels/recall.hpp"

#include "bindings/arrays.hpp"

#include <string>

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Input;

void require(bool holds, const char *what) {
  if (!holds)
    throw nb::value_error((std::string("recall_order: ") + what).c_str());
}

template <typename T> void require_length(const Input<T, 1> &array, size_t count) {
  require(array.shape(0) == count, "arrays of one group must have one length");
}

// This run's attempts and the candidates: they hold on to their arrays.
struct Run {
  double driven_m;
  Input<double, 1> at_m;
  Input<int32_t, 1> nodes, sessions;
  Input<double, 1> distance_m, rates;
  Input<bool, 1> accepted;
  Input<int64_t, 1> inliers;

  Run(double driven_m, Input<double, 1> at_m, Input<int32_t, 1> nodes, Input<int32_t, 1> sessions,
      Input<double, 1> distance_m, Input<double, 1> rates, Input<bool, 1> accepted,
      Input<int64_t, 1> inliers)
      : driven_m(driven_m), at_m(at_m), nodes(nodes), sessions(sessions), distance_m(distance_m),
        rates(rates), accepted(accepted), inliers(inliers) {
    const size_t count = nodes.shape(0);
    require_length(at_m, count);
    require_length(sessions, count);
    require_length(distance_m, count);
    require_length(rates, count);
    require_length(accepted, count);
    require_length(inliers, count);
  }
};

struct Candidates {
  Input<int32_t, 1> nodes, sessions;
  Input<double, 1> costs, prior;

  Candidates(Input<int32_t, 1> nodes, Input<int32_t, 1> sessions, Input<double, 1> costs,
             Input<double, 1> prior)
      : nodes(nodes), sessions(sessions), costs(costs), prior(prior) {
    require_length(sessions, nodes.shape(0));
    require_length(costs, nodes.shape(0));
    require_length(prior, nodes.shape(0));
  }
};

void check(const engram::RecallConstants &c) {
  require(c.memory_m > 0 && c.tally_memory_m > 0 && c.prior_weight > 0,
          "memories and prior weight must be positive");
  require(c.untried_rate > 0 && c.untried_attempts > 0,
          "what is untried must have a rate and a worth");
  require(c.regret >= 0, "regret must not be negative");
  require(c.needed > 0, "a match must need inliers");
  require(c.attempts >= 0 && c.picks >= 0 && c.shortlist >= 0,
          "attempts, picks and shortlist must not be negative");
}

auto recall_order(const Run &run, const Candidates &candidates,
                  const engram::RecallConstants &constants) {
  const size_t count = candidates.nodes.shape(0);
  check(constants);
  engram::RecallJudgement judged;
  {
    nb::gil_scoped_release unlocked;
    const engram::RecallRun made{run.driven_m,
                                 run.at_m.data(),
                                 run.nodes.data(),
                                 run.sessions.data(),
                                 run.distance_m.data(),
                                 run.rates.data(),
                                 reinterpret_cast<const uint8_t *>(run.accepted.data()),
                                 run.inliers.data(),
                                 static_cast<int64_t>(run.nodes.shape(0))};
    const engram::RecallCandidates seen{candidates.nodes.data(),      candidates.sessions.data(),
                                        candidates.costs.data(),      candidates.prior.data(),
                                        static_cast<int64_t>(count)};
    judged = ENGRAM_CALL(recall_order, made, seen, constants);
  }
  return nb::make_tuple(engram::to_numpy(std::move(judged.order), {count}),
                        engram::to_numpy(std::move(judged.margins), {count}),
                        engram::to_numpy(std::move(judged.first), {count}),
                        engram::to_numpy(std::move(judged.tally), {count}));
}

} // namespace

void bind_recall(nb::module_ &module) {
  nb::class_<Run>(module, "RecallRun", "Attempts of this run, oldest first, (R,) each.")
      .def(nb::init<double, Input<double, 1>, Input<int32_t, 1>, Input<int32_t, 1>,
                    Input<double, 1>, Input<double, 1>, Input<bool, 1>, Input<int64_t, 1>>(),
           "driven_m"_a, "at_m"_a, "nodes"_a, "sessions"_a, "distance_m"_a, "rates"_a, "accepted"_a,
           "inliers"_a);
  nb::class_<Candidates>(module, "RecallCandidates",
                         "The candidates, nearest first, (Y,) each.")
      .def(nb::init<Input<int32_t, 1>, Input<int32_t, 1>, Input<double, 1>, Input<double, 1>>(),
           "nodes"_a, "sessions"_a, "costs"_a, "prior"_a);
  using engram::RecallConstants;
  nb::class_<RecallConstants>(module, "RecallConstants",
                              "See `engram.ranking.recall.RecallConstants`.")
      .def(nb::init<>())
      .def_rw("per_m", &RecallConstants::per_m)
      .def_rw("level", &RecallConstants::level)
      .def_rw("memory_m", &RecallConstants::memory_m)
      .def_rw("prior_weight", &RecallConstants::prior_weight)
      .def_rw("regret", &RecallConstants::regret)
      .def_rw("tally", &RecallConstants::tally)
      .def_rw("tally_memory_m", &RecallConstants::tally_memory_m)
      .def_rw("untried_rate", &RecallConstants::untried_rate)
      .def_rw("untried_attempts", &RecallConstants::untried_attempts)
      .def_rw("needed", &RecallConstants::needed)
      .def_rw("attempts", &RecallConstants::attempts)
      .def_rw("picks", &RecallConstants::picks)
      .def_rw("shortlist", &RecallConstants::shortlist);
  module.def("recall_order", &recall_order, "run"_a, "candidates"_a, "constants"_a,
             "Rows (Y,) int64 best first; by row (Y,) the margin as picked, at first, and what of "
             "it is the tally's.");
}
