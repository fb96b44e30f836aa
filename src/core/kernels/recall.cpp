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

// What this run has shown of one session's drive.
struct Shown {
  Tally margins;
  double successes = 0, failures = 0;
};

class Picking {
public:
  Picking(const RecallRun &run, const RecallCandidates &candidates,
          const RecallConstants &constants)
      : candidates_(candidates), constants_(constants),
        failed_(-std::log(static_cast<double>(constants.needed))),
        sessions_(candidates.sessions, candidates.sessions + candidates.count),
        of_nodes_(at(candidates.count)) {
    std::sort(sessions_.begin(), sessions_.end());
    sessions_.erase(std::unique(sessions_.begin(), sessions_.end()), sessions_.end());
    of_sessions_.resize(sessions_.size());
    for (int64_t row = 0; row < candidates.count; ++row)
      session_of_.push_back(at(place_of(candidates.sessions[row])));
    hear(run);
    const size_t count = at(candidates.count);
    judged.tally.resize(count);
    judged.margins.resize(count);
    for (int64_t row = 0; row < candidates.count; ++row) {
      judged.tally[at(row)] = tally(of_sessions_[session(row)]);
      judge(row);
    }
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
  size_t session(int64_t row) const { return session_of_[at(row)]; }

  // Among those of the candidates, or their number: a map has many more.
  int64_t place_of(int32_t session) const {
    const auto found = std::lower_bound(sessions_.begin(), sessions_.end(), session);
    const bool known = found != sessions_.end() && *found == session;
    return (known ? found : sessions_.end()) - sessions_.begin();
  }

  // A failure without a prediction tells nothing: a lost robot has dozens of them in every frame.
  static bool tells(const RecallRun &run, int64_t j) {
    return run.accepted[j] || !std::isnan(run.distance_m[j]);
  }

  // The newest attempts, oldest first. Each speaks for its session, and once more for the very node.
  void hear(const RecallRun &run) {
    int64_t first = run.count;
    for (int64_t telling = 0; first > 0 && telling < constants_.attempts; --first)
      telling += tells(run, first - 1);
    std::vector<std::pair<int32_t, int64_t>> rows;
    rows.reserve(at(candidates_.count));
    for (int64_t row = 0; row < candidates_.count; ++row)
      rows.emplace_back(candidates_.nodes[row], row);
    std::sort(rows.begin(), rows.end());
    for (int64_t j = first; j < run.count; ++j) {
      if (!tells(run, j))
        continue;
      const double back_m = run.at_m[j] - run.driven_m;
      const int64_t place = place_of(run.sessions[j]);
      Shown elsewhere;
      Shown &drive = at(place) < sessions_.size() ? of_sessions_[at(place)] : elsewhere;
      count(run, j, std::exp(back_m / constants_.tally_memory_m), drive);
      const double margin = margin_of(run, j);
      if (std::isnan(margin))
        continue;
      const double weight = std::exp(back_m / constants_.memory_m);
      drive.margins.add(weight, margin);
      auto found = std::lower_bound(rows.begin(), rows.end(), std::pair(run.nodes[j], int64_t{0}));
      for (; found != rows.end() && found->first == run.nodes[j]; ++found)
        of_nodes_[at(found->second)].add(weight, margin);
    }
  }

  // A failure counts as much as a match was likely.
  static void count(const RecallRun &run, int64_t j, double weight, Shown &drive) {
    if (run.accepted[j])
      drive.successes += weight;
    else if (!std::isnan(run.rates[j]))
      drive.failures += weight * run.rates[j];
  }

  // What an attempt would have come to at no distance; NaN where it does not tell.
  double margin_of(const RecallRun &run, int64_t j) const {
    const int64_t inliers = std::max(run.inliers[j], int64_t{1});
    double margin = failed_;
    // A match that is refused though it has inliers enough is one of something else.
    if (run.accepted[j] || inliers < constants_.needed)
      margin += std::log(static_cast<double>(inliers));
    // A success without a prediction tells as much as if it had been made here.
    if (!std::isnan(run.distance_m[j]))
      margin += constants_.per_m * run.distance_m[j];
    // From so far away nobody was expected to match.
    return !run.accepted[j] && margin > constants_.level ? std::nan("") : margin;
  }

  // Margin won by the rate at which this run matched the drive. Failures add up here as long as
  // they go on, so that no candidate is tried for ever.
  double tally(const Shown &drive) const {
    const double rate = constants_.untried_rate, worth = constants_.untried_attempts;
    const double successes = drive.successes + rate * worth;
    return constants_.tally *
           std::log(successes / (drive.successes + drive.failures + worth) / rate);
  }

  void judge(int64_t row) {
    const Tally &whole = of_sessions_[session(row)].margins;
    const Tally &own = of_nodes_[at(row)];
    const double prior = constants_.prior_weight;
    const double mean = (prior * candidates_.prior[row] + whole.sum + own.sum) /
                        (prior + whole.weight + own.weight);
    judged.margins[at(row)] = mean - cost(row);
  }

  double cost(int64_t row) const { return candidates_.costs[row] - judged.tally[at(row)]; }

  void suppose_failure(int64_t picked, int64_t from, int64_t to) {
    const size_t same = session(picked);
    of_sessions_[same].margins.add(constants_.regret, failed_ + cost(picked));
    for (int64_t place = from; place < to; ++place) {
      const int64_t other = judged.order[at(place)];
      if (session(other) == same)
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
  const double failed_; // margin of an attempt that came to nothing: as if of one inlier
  std::vector<int32_t> sessions_;   // of the candidates, ascending
  std::vector<size_t> session_of_;  // by row, its place among them
  std::vector<Shown> of_sessions_;
  std::vector<Tally> of_nodes_;
};

} // namespace

RecallJudgement recall_order(const RecallRun &run, const RecallCandidates &candidates,
                             const RecallConstants &constants) {
  Picking picking(run, candidates, constants);
  picking.pick();
  return std::move(picking.judged);
}

} // namespace engram::ENGRAM_ISA
