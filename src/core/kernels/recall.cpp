#include "kernels/recall.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

// The next pick is made as if those before it had failed: that maximises the chance that any of them
// succeeds, as far as the model goes, and spreads the picks over experiences that do not fail
// together.

namespace engram::ENGRAM_ISA {
namespace {

constexpr double kLeastChance = 1e-3;

double log_odds(double p) {
  p = std::clamp(p, kLeastChance, 1 - kLeastChance);
  return std::log(p / (1 - p));
}

// How much the live drive is like each past one.
class Viewers {
public:
  Viewers(const RecallLessons &lessons, const double *prior, const RecallConstants &constants)
      : lessons_(lessons), nobody_(std::log(constants.nobody)),
        log_weights_(prior, prior + lessons.viewer_count) {}

  // A success or failure on a node, by its weights.
  void learn(int32_t node, double success, double failure) {
    if (node >= lessons_.nodes)
      return;
    for (int64_t e = lessons_.starts[node]; e < lessons_.starts[node + 1]; ++e)
      log_weights_[static_cast<size_t>(lessons_.viewers[e])] +=
          success * static_cast<double>(lessons_.on_success[e]) +
          failure * static_cast<double>(lessons_.on_failure[e]);
  }

  // A node at which a match was as likely as `rate`, had appearances been compatible, failed.
  void suppose_failure(int32_t node, double rate, double base, double regret) {
    const double of_others = std::log(1 - rate * base);
    if (node < lessons_.nodes)
      for (int64_t e = lessons_.starts[node]; e < lessons_.starts[node + 1]; ++e)
        log_weights_[static_cast<size_t>(lessons_.viewers[e])] +=
            regret *
            (std::log(1 - rate * static_cast<double>(lessons_.rates[e])) - of_others);
  }

  // Weights that add up to 1, together with that of being like none.
  void normalise() {
    double greatest = nobody_;
    for (const double value : log_weights_)
      greatest = std::max(greatest, value);
    double sum = std::exp(nobody_ - greatest);
    weights_.resize(log_weights_.size());
    for (size_t m = 0; m < weights_.size(); ++m) {
      // e^-40 of the best weighs nothing, and an exponential costs more than to see that.
      const double below = log_weights_[m] - greatest;
      weights_[m] = below > -40 ? std::exp(below) : 0;
      sum += weights_[m];
    }
    for (double &weight : weights_)
      weight /= sum;
  }

  // Share of like-minded drives that match a node; those that never tried do as all others do.
  double company(int32_t node, double base) const {
    if (node >= lessons_.nodes)
      return base;
    double sum = 0;
    for (int64_t e = lessons_.starts[node]; e < lessons_.starts[node + 1]; ++e)
      sum += weights_[static_cast<size_t>(lessons_.viewers[e])] *
             (static_cast<double>(lessons_.rates[e]) - base);
    return base + sum;
  }

  const std::vector<double> &weights() const { return weights_; }

private:
  const RecallLessons &lessons_;
  double nobody_;
  std::vector<double> log_weights_, weights_;
};

class Picking {
public:
  Picking(const RecallLessons &lessons, Viewers &viewers, const RecallCandidates &candidates,
          const RecallConstants &constants)
      : lessons_(lessons), viewers_(viewers), candidates_(candidates), constants_(constants),
        failures_(candidates.failures, candidates.failures + candidates.count) {}

  double base(int64_t row) const {
    const int32_t node = candidates_.nodes[row];
    return node < lessons_.nodes ? lessons_.base[node] : constants_.unknown_base;
  }

  double company(int64_t row) const { return viewers_.company(candidates_.nodes[row], base(row)); }

  double chance(int64_t row, double company) const {
    const double own = std::log((candidates_.successes[row] + constants_.pseudo) /
                                (failures_[static_cast<size_t>(row)] + constants_.pseudo));
    const double odds =
        candidates_.fixed[row] + constants_.company * log_odds(company) + constants_.own * own;
    return 1 / (1 + std::exp(-odds));
  }

  void suppose_failure(int64_t row) {
    const double rate = std::clamp(candidates_.rates[row], 0.0, 1 - kLeastChance);
    viewers_.suppose_failure(candidates_.nodes[row], rate, base(row), constants_.regret);
    viewers_.normalise();
    for (int64_t other = 0; other < candidates_.count; ++other)
      if (candidates_.groups[other] == candidates_.groups[row])
        failures_[static_cast<size_t>(other)] += constants_.regret * rate;
  }

private:
  const RecallLessons &lessons_;
  Viewers &viewers_;
  const RecallCandidates &candidates_;
  const RecallConstants &constants_;
  std::vector<double> failures_;
};

} // namespace

RecallJudgement recall_order(const RecallLessons &lessons, const RecallRun &run,
                             const double *prior, const RecallCandidates &candidates,
                             const RecallConstants &constants) {
  Viewers viewers(lessons, prior, constants);
  for (int64_t j = 0; j < run.count; ++j)
    viewers.learn(run.nodes[j], constants.trust * run.successes[j],
                  constants.trust * run.failures[j]);
  viewers.normalise();
  Picking picking(lessons, viewers, candidates, constants);
  const auto count = static_cast<size_t>(candidates.count);
  RecallJudgement judged;
  judged.viewers = viewers.weights();
  judged.company.resize(count);
  judged.chances.resize(count);
  for (size_t row = 0; row < count; ++row) {
    judged.company[row] = picking.company(static_cast<int64_t>(row));
    judged.chances[row] = picking.chance(static_cast<int64_t>(row), judged.company[row]);
  }
  std::vector<int64_t> &order = judged.order;
  order.resize(count);
  std::iota(order.begin(), order.end(), int64_t{0});
  std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) {
    return judged.chances[static_cast<size_t>(a)] > judged.chances[static_cast<size_t>(b)];
  });
  const auto shortlist = std::min<int64_t>(constants.shortlist, candidates.count);
  const auto picks = std::min(constants.picks, shortlist);
  // The shortlist back in the order of rows: of equals the first is preferred.
  std::sort(order.begin(), order.begin() + shortlist);
  for (int64_t pick = 0; pick < picks; ++pick) {
    int64_t best = pick;
    double greatest = -1;
    for (int64_t place = pick; place < shortlist; ++place) {
      const int64_t row = order[static_cast<size_t>(place)];
      if (pick > 0)
        judged.chances[static_cast<size_t>(row)] = picking.chance(row, picking.company(row));
      if (judged.chances[static_cast<size_t>(row)] > greatest) {
        greatest = judged.chances[static_cast<size_t>(row)];
        best = place;
      }
    }
    std::rotate(order.begin() + pick, order.begin() + best, order.begin() + best + 1);
    picking.suppose_failure(order[static_cast<size_t>(pick)]);
  }
  std::stable_sort(order.begin() + picks, order.begin() + shortlist, [&](int64_t a, int64_t b) {
    return judged.chances[static_cast<size_t>(a)] > judged.chances[static_cast<size_t>(b)];
  });
  return judged;
}

} // namespace engram::ENGRAM_ISA
