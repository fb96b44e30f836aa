#include "kernels/recall.hpp"

#include "bindings/arrays.hpp"

#include <cmath>
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

// Lessons whose rows lie within their entries. They are checked when they are made, too: this only
// keeps the kernel from reading out of bounds.
class Lessons {
public:
  Lessons(const Input<int64_t, 1> &starts, const Input<int32_t, 1> &viewers,
          const Input<float, 1> &rates, const Input<float, 1> &on_success,
          const Input<float, 1> &on_failure, const Input<double, 1> &base, int64_t viewer_count)
      : starts_(starts), viewers_(viewers), rates_(rates), on_success_(on_success),
        on_failure_(on_failure), base_(base), viewer_count_(viewer_count) {
    const size_t entries = viewers.shape(0);
    require_length(rates, entries);
    require_length(on_success, entries);
    require_length(on_failure, entries);
    require(starts.shape(0) == base.shape(0) + 1, "starts must have one more than base");
    require(starts.data()[0] == 0, "starts must begin with 0");
    for (size_t i = 0; i + 1 < starts.shape(0); ++i)
      require(starts.data()[i] <= starts.data()[i + 1], "starts must not fall");
    require(starts.data()[base.shape(0)] == static_cast<int64_t>(entries),
            "starts must end with the number of entries");
    for (size_t e = 0; e < entries; ++e)
      require(viewers.data()[e] >= 0 && viewers.data()[e] < viewer_count, "no such viewer");
  }

  engram::RecallLessons view() const {
    return {starts_.data(),     viewers_.data(),
            rates_.data(),      on_success_.data(),
            on_failure_.data(), base_.data(),
            static_cast<int64_t>(base_.shape(0)), viewer_count_};
  }

private:
  Input<int64_t, 1> starts_;
  Input<int32_t, 1> viewers_;
  Input<float, 1> rates_, on_success_, on_failure_;
  Input<double, 1> base_;
  int64_t viewer_count_;
};

auto recall_order(const Lessons &lessons, const Input<int32_t, 1> &run_nodes,
                  const Input<double, 1> &run_ago_m, const Input<double, 1> &run_rates,
                  const Input<bool, 1> &run_accepted, const Input<double, 1> &prior,
                  const Input<int32_t, 1> &nodes, const Input<double, 1> &rates,
                  const Input<double, 1> &fixed, const Input<int32_t, 1> &sessions,
                  int64_t session_count, double company, double own, double node, double own_m,
                  double node_m, double viewers_m, double trust, double nobody,
                  double unknown_base, double pseudo, double regret, int64_t picks,
                  int64_t shortlist) {
  const size_t count = nodes.shape(0), attempts = run_nodes.shape(0);
  check_nodes(nodes, sessions, session_count);
  check_nodes(run_nodes, sessions, session_count);
  require_length(run_ago_m, attempts);
  require_length(run_rates, attempts);
  require_length(run_accepted, attempts);
  require_length(prior, static_cast<size_t>(lessons.view().viewer_count));
  require_length(rates, count);
  require_length(fixed, count);
  require(nobody > 0 && pseudo > 0, "nobody and pseudo must be positive");
  require(own_m > 0 && node_m > 0 && viewers_m > 0, "memories must be positive");
  require(picks >= 0 && shortlist >= 0, "picks and shortlist must not be negative");
  engram::RecallJudgement judged;
  {
    nb::gil_scoped_release unlocked;
    const engram::RecallRun run{run_nodes.data(), run_ago_m.data(), run_rates.data(),
                                run_accepted.data(), static_cast<int64_t>(attempts)};
    const engram::RecallCandidates candidates{nodes.data(),
                                              rates.data(),
                                              fixed.data(),
                                              static_cast<int64_t>(count),
                                              sessions.data(),
                                              static_cast<int64_t>(sessions.shape(0)),
                                              session_count};
    const engram::RecallConstants constants{company, own,    node,         own_m,  node_m,
                                            viewers_m, trust, nobody,       unknown_base,
                                            pseudo,  regret, picks,        shortlist};
    judged = ENGRAM_CALL(recall_order, lessons.view(), run, prior.data(), candidates, constants);
  }
  const size_t viewer_count = judged.viewers.size();
  return nb::make_tuple(engram::to_numpy(std::move(judged.order), {count}),
                        engram::to_numpy(std::move(judged.chances), {count}),
                        engram::to_numpy(std::move(judged.company), {count}),
                        engram::to_numpy(std::move(judged.own), {count}),
                        engram::to_numpy(std::move(judged.node), {count}),
                        engram::to_numpy(std::move(judged.viewers), {viewer_count}));
}

} // namespace

void bind_recall(nb::module_ &module) {
  nb::class_<Lessons>(module, "RecallLessons",
                      "What past drives learnt at each node, a row of entries per node.")
      .def(nb::init<const Input<int64_t, 1> &, const Input<int32_t, 1> &, const Input<float, 1> &,
                    const Input<float, 1> &, const Input<float, 1> &, const Input<double, 1> &,
                    int64_t>(),
           "starts"_a, "viewers"_a, "rates"_a, "on_success"_a, "on_failure"_a, "base"_a,
           "viewer_count"_a);
  module.def("recall_order", &recall_order, "lessons"_a, "run_nodes"_a, "run_ago_m"_a,
             "run_rates"_a, "run_accepted"_a, "prior"_a, "nodes"_a, "rates"_a, "fixed"_a,
             "sessions"_a, "session_count"_a, nb::kw_only(), "company"_a, "own"_a, "node"_a,
             "own_m"_a, "node_m"_a, "viewers_m"_a, "trust"_a, "nobody"_a, "unknown_base"_a,
             "pseudo"_a, "regret"_a, "picks"_a, "shortlist"_a,
             "Rows (Y,) int64 best first; by row (Y,) the chance as picked, the company, and the "
             "log odds of this run's tallies on session and node; by viewer its weight (V,).");
}
