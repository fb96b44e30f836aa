#include "kernels/recall.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

// The next pick is made as if those before it had failed: that spreads the picks over experiences
// that do not fail together.

namespace engram::ENGRAM_ISA {
namespace {

size_t at(int64_t index) { return static_cast<size_t>(index); }

// A weighted mean in the making.
struct Tally {
  double weight = 0, sum = 0;

  void add(double more, double value) {
    weight += more;
    sum += more * value;
  }
};

class Picking {
public:
  Picking(const RecallRun &run, const RecallCandidates &candidates,
          const RecallConstants &constants)
      : candidates_(candidates), constants_(constants),
        of_sessions_(at(candidates.session_count)), of_nodes_(at(candidates.count)) {
    tally(run);
    const size_t count = at(candidates.count);
    judged.margins.resize(count);
    for (int64_t row = 0; row < candidates.count; ++row)
      judge(row);
    judged.first = judged.margins;
    judged.order.resize(count);
    std::iota(judged.order.begin(), judged.order.end(), int64_t{0});
    sort(0, candidates.count);
  }

  // The shortlist in the order of greedy picks, then by what is left of its margins.
  void pick() {
    std::vector<int64_t> &order = judged.order;
    const auto shortlist = std::min(constants_.shortlist, candidates_.count);
    const auto picks = std::min(constants_.picks, shortlist);
    // Back in the order of rows: of equals the first is preferred.
    std::sort(order.begin(), order.begin() + shortlist);
    for (int64_t place = 0; place < picks; ++place) {
      if (place > 0)
        suppose_failure(order[at(place - 1)], place, shortlist);
      const auto best = std::max_element(
          order.begin() + place, order.begin() + shortlist, [&](int64_t a, int64_t b) {
            return judged.margins[at(a)] < judged.margins[at(b)];
          });
      std::rotate(order.begin() + place, best, best + 1);
    }
    sort(picks, shortlist);
  }

  RecallJudgement judged;

private:
  size_t session(int32_t node) const { return at(candidates_.sessions[node]); }

  // Each attempt speaks for its session, and once more for the very node.
  void tally(const RecallRun &run) {
    std::vector<std::pair<int32_t, int64_t>> rows;
    rows.reserve(at(candidates_.count));
    for (int64_t row = 0; row < candidates_.count; ++row)
      rows.emplace_back(candidates_.nodes[row], row);
    std::sort(rows.begin(), rows.end());
    for (int64_t j = 0; j < run.count; ++j) {
      if (std::isnan(run.margins[j]))
        continue;
      const double weight = std::exp(-run.ago_m[j] / constants_.memory_m);
      of_sessions_[session(run.nodes[j])].add(weight, run.margins[j]);
      auto found = std::lower_bound(rows.begin(), rows.end(), std::pair(run.nodes[j], int64_t{0}));
      for (; found != rows.end() && found->first == run.nodes[j]; ++found)
        of_nodes_[at(found->second)].add(weight, run.margins[j]);
    }
  }

  void judge(int64_t row) {
    const Tally &whole = of_sessions_[session(candidates_.nodes[row])], &own = of_nodes_[at(row)];
    const double prior = constants_.prior_weight;
    const double mean = (prior * candidates_.prior[row] + whole.sum + own.sum) /
                        (prior + whole.weight + own.weight);
    judged.margins[at(row)] = mean - candidates_.costs[row];
  }

  void suppose_failure(int64_t picked, int64_t from, int64_t to) {
    const size_t same = session(candidates_.nodes[picked]);
    of_sessions_[same].add(constants_.regret, constants_.failed + candidates_.costs[picked]);
    for (int64_t place = from; place < to; ++place) {
      const int64_t other = judged.order[at(place)];
      if (session(candidates_.nodes[other]) == same)
        judge(other);
    }
  }

  void sort(int64_t from, int64_t to) {
    std::stable_sort(
        judged.order.begin() + from, judged.order.begin() + to,
        [&](int64_t a, int64_t b) { return judged.margins[at(a)] > judged.margins[at(b)]; });
  }

  const RecallCandidates &candidates_;
  const RecallConstants &constants_;
  std::vector<Tally> of_sessions_, of_nodes_;
};

} // namespace

RecallJudgement recall_order(const RecallRun &run, const RecallCandidates &candidates,
                             const RecallConstants &constants) {
  Picking picking(run, candidates, constants);
  picking.pick();
  return std::move(picking.judged);
}

} // namespace engram::ENGRAM_ISA
