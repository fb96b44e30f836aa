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

void check_nodes(const Input<int32_t, 1> &nodes, const Input<int32_t, 1> &sessions,
                 int64_t session_count) {
  for (size_t i = 0; i < nodes.shape(0); ++i) {
    const int32_t node = nodes.data()[i];
    require(node >= 0 && static_cast<size_t>(node) < sessions.shape(0), "no such node");
    require(sessions.data()[node] >= 0 && sessions.data()[node] < session_count,
            "no such session");
  }
}

auto recall_order(double driven_m, const Input<double, 1> &at_m, const Input<int32_t, 1> &attempted,
                  const Input<double, 1> &distance_m, const Input<double, 1> &rates,
                  const Input<bool, 1> &accepted, const Input<int64_t, 1> &inliers,
                  const Input<int32_t, 1> &nodes, const Input<double, 1> &costs,
                  const Input<double, 1> &prior, const Input<int32_t, 1> &sessions,
                  int64_t session_count, double per_m, double level, double memory_m,
                  double prior_weight, double regret, double tally, double tally_memory_m,
                  double untried_rate, double untried_count, int64_t needed, int64_t attempts,
                  int64_t picks, int64_t shortlist) {
  const size_t count = nodes.shape(0), made = attempted.shape(0);
  check_nodes(nodes, sessions, session_count);
  check_nodes(attempted, sessions, session_count);
  require_length(at_m, made);
  require_length(distance_m, made);
  require_length(rates, made);
  require_length(accepted, made);
  require_length(inliers, made);
  require_length(costs, count);
  require_length(prior, count);
  require(memory_m > 0 && tally_memory_m > 0 && prior_weight > 0,
          "memories and prior weight must be positive");
  require(untried_rate > 0 && untried_count > 0, "what is untried must have a rate and a worth");
  require(regret >= 0, "regret must not be negative");
  require(needed > 0, "a match must need inliers");
  require(attempts >= 0 && picks >= 0 && shortlist >= 0,
          "attempts, picks and shortlist must not be negative");
  engram::RecallJudgement judged;
  {
    nb::gil_scoped_release unlocked;
    const engram::RecallRun run{driven_m,
                                at_m.data(),
                                attempted.data(),
                                distance_m.data(),
                                rates.data(),
                                reinterpret_cast<const uint8_t *>(accepted.data()),
                                inliers.data(),
                                static_cast<int64_t>(made)};
    const engram::RecallCandidates candidates{nodes.data(),
                                              costs.data(),
                                              prior.data(),
                                              static_cast<int64_t>(count),
                                              sessions.data(),
                                              static_cast<int64_t>(sessions.shape(0)),
                                              session_count};
    const engram::RecallConstants constants{per_m,        level,         memory_m, prior_weight,
                                            regret,       tally,         tally_memory_m,
                                            untried_rate, untried_count, needed,   attempts,
                                            picks,        shortlist};
    judged = ENGRAM_CALL(recall_order, run, candidates, constants);
  }
  return nb::make_tuple(engram::to_numpy(std::move(judged.order), {count}),
                        engram::to_numpy(std::move(judged.margins), {count}),
                        engram::to_numpy(std::move(judged.first), {count}),
                        engram::to_numpy(std::move(judged.tally), {count}));
}

} // namespace

void bind_recall(nb::module_ &module) {
  module.def("recall_order", &recall_order, "driven_m"_a, "at_m"_a, "attempted"_a, "distance_m"_a,
             "rates"_a, "accepted"_a, "inliers"_a, "nodes"_a, "costs"_a, "prior"_a, "sessions"_a,
             "session_count"_a, nb::kw_only(), "per_m"_a, "level"_a, "memory_m"_a,
             "prior_weight"_a, "regret"_a, "tally"_a, "tally_memory_m"_a, "untried_rate"_a,
             "untried_count"_a, "needed"_a, "attempts"_a, "picks"_a, "shortlist"_a,
             "Rows (Y,) int64 best first; by row (Y,) the margin as picked, at first, and what of "
             "it is the tally's.");
}
