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

void check_nodes(const Input<int32_t, 1> &nodes) {
  for (size_t i = 0; i < nodes.shape(0); ++i)
    require(nodes.data()[i] >= 0, "nodes must not be negative");
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
                  const Input<double, 1> &run_successes, const Input<double, 1> &run_failures,
                  const Input<double, 1> &prior, const Input<int32_t, 1> &nodes,
                  const Input<int32_t, 1> &groups, const Input<double, 1> &rates,
                  const Input<double, 1> &fixed, const Input<double, 1> &successes,
                  const Input<double, 1> &failures, double trust, double nobody,
                  double unknown_base, double company, double own, double pseudo, double regret,
                  int64_t picks, int64_t shortlist) {
  const size_t count = nodes.shape(0);
  check_nodes(nodes);
  check_nodes(run_nodes);
  require_length(run_successes, run_nodes.shape(0));
  require_length(run_failures, run_nodes.shape(0));
  require_length(prior, static_cast<size_t>(lessons.view().viewer_count));
  require_length(groups, count);
  require_length(rates, count);
  require_length(fixed, count);
  require_length(successes, count);
  require_length(failures, count);
  require(nobody > 0 && pseudo > 0, "nobody and pseudo must be positive");
  require(picks >= 0 && shortlist >= 0, "picks and shortlist must not be negative");
  engram::RecallJudgement judged;
  {
    nb::gil_scoped_release unlocked;
    const engram::RecallRun run{run_nodes.data(), run_successes.data(), run_failures.data(),
                                static_cast<int64_t>(run_nodes.shape(0))};
    const engram::RecallCandidates candidates{
        nodes.data(),     groups.data(),   rates.data(),
        fixed.data(),     successes.data(), failures.data(),
        static_cast<int64_t>(count)};
    const engram::RecallConstants constants{trust,  nobody, unknown_base, company,  own,
                                            pseudo, regret, picks,        shortlist};
    judged = ENGRAM_CALL(recall_order, lessons.view(), run, prior.data(), candidates, constants);
  }
  const size_t viewer_count = judged.viewers.size();
  return nb::make_tuple(engram::to_numpy(std::move(judged.order), {count}),
                        engram::to_numpy(std::move(judged.chances), {count}),
                        engram::to_numpy(std::move(judged.company), {count}),
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
  module.def("recall_order", &recall_order, "lessons"_a, "run_nodes"_a, "run_successes"_a,
             "run_failures"_a, "prior"_a, "nodes"_a, "groups"_a, "rates"_a, "fixed"_a,
             "successes"_a, "failures"_a, nb::kw_only(), "trust"_a, "nobody"_a, "unknown_base"_a,
             "company"_a, "own"_a, "pseudo"_a, "regret"_a, "picks"_a, "shortlist"_a,
             "Rows (Y,) int64 best first; by row the chance as picked and the company (Y,); by "
             "viewer its weight (V,).");
}
