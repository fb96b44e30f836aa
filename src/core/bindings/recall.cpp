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

auto recall_order(const Input<int32_t, 1> &run_nodes, const Input<double, 1> &run_ago_m,
                  const Input<double, 1> &run_margins, const Input<int32_t, 1> &nodes,
                  const Input<double, 1> &costs, const Input<double, 1> &prior,
                  const Input<int32_t, 1> &sessions, int64_t session_count, double memory_m,
                  double prior_weight, double failed, double regret, int64_t picks,
                  int64_t shortlist) {
  const size_t count = nodes.shape(0), attempts = run_nodes.shape(0);
  check_nodes(nodes, sessions, session_count);
  check_nodes(run_nodes, sessions, session_count);
  require_length(run_ago_m, attempts);
  require_length(run_margins, attempts);
  require_length(costs, count);
  require_length(prior, count);
  require(memory_m > 0 && prior_weight > 0, "memory and prior weight must be positive");
  require(regret >= 0, "regret must not be negative");
  require(picks >= 0 && shortlist >= 0, "picks and shortlist must not be negative");
  engram::RecallJudgement judged;
  {
    nb::gil_scoped_release unlocked;
    const engram::RecallRun run{run_nodes.data(), run_ago_m.data(), run_margins.data(),
                                static_cast<int64_t>(attempts)};
    const engram::RecallCandidates candidates{nodes.data(),
                                              costs.data(),
                                              prior.data(),
                                              static_cast<int64_t>(count),
                                              sessions.data(),
                                              static_cast<int64_t>(sessions.shape(0)),
                                              session_count};
    const engram::RecallConstants constants{memory_m, prior_weight, failed,
                                            regret,   picks,        shortlist};
    judged = ENGRAM_CALL(recall_order, run, candidates, constants);
  }
  return nb::make_tuple(engram::to_numpy(std::move(judged.order), {count}),
                        engram::to_numpy(std::move(judged.margins), {count}),
                        engram::to_numpy(std::move(judged.first), {count}));
}

} // namespace

void bind_recall(nb::module_ &module) {
  module.def("recall_order", &recall_order, "run_nodes"_a, "run_ago_m"_a, "run_margins"_a,
             "nodes"_a, "costs"_a, "prior"_a, "sessions"_a, "session_count"_a, nb::kw_only(),
             "memory_m"_a, "prior_weight"_a, "failed"_a, "regret"_a, "picks"_a, "shortlist"_a,
             "Rows (Y,) int64 best first; by row (Y,) the margin as picked, and at first.");
}
