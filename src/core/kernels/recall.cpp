#include "kernels/recall.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

// The next pick is made as if those before it had failed: that maximises the chance that any of them
// succeeds, as far as the model goes, and spreads the picks over experiences that do not fail
// together.

namespace engram::ENGRAM_ISA {
namespace {

constexpr double kLeastChance = 1e-3;

size_t at(int64_t index) { return static_cast<size_t>(index); }

double log_odds(double p) {
  p = std::clamp(p, kLeastChance, 1 - kLeastChance);
  return std::log(p / (1 - p));
}

// How much a failure tells: as much as a match was likely, nothing where nothing was predicted.
double failure_weight(const RecallRun &run, int64_t j) {
  return run.accepted[j] || std::isnan(run.rates[j]) ? 0 : run.rates[j];
}

// How much the live drive is like each past one.
class Viewers {
public:
  Viewers(const RecallLessons &lessons, const RecallRun &run, const double *prior,
          const RecallConstants &constants)
      : lessons_(lessons), weights_(prior, prior + lessons.viewer_count) {
    for (int64_t j = 0; j < run.count; ++j)
      learn(run, j, constants.trust * std::exp(-run.ago_m[j] / constants.viewers_m));
    const double nobody = std::log(constants.nobody);
    double greatest = nobody;
    for (const double value : weights_)
      greatest = std::max(greatest, value);
    sum_ = std::exp(nobody - greatest);
    for (double &weight : weights_) {
      // e^-40 of the best weighs nothing, and an exponential costs more than to see that.
      const double below = weight - greatest;
      weight = below > -40 ? std::exp(below) : 0;
      sum_ += weight;
    }
  }

  // Share of like-minded drives that match a node; those that never tried do as all others do.
  double company(int32_t node, double base) const {
    if (node >= lessons_.nodes)
      return base;
    double sum = 0;
    for (int64_t e = lessons_.starts[node]; e < lessons_.starts[node + 1]; ++e)
      sum += weights_[at(lessons_.viewers[e])] * (static_cast<double>(lessons_.rates[e]) - base);
    return base + sum / sum_;
  }

  // A node at which a match was as likely as `rate`, had appearances been compatible, failed.
  // Against those who never tried it, only the weight of those who did changes.
  void suppose_failure(int32_t node, double rate, double base, double regret) {
    if (node >= lessons_.nodes || regret == 0)
      return;
    for (int64_t e = lessons_.starts[node]; e < lessons_.starts[node + 1]; ++e) {
      double &weight = weights_[at(lessons_.viewers[e])];
      const double ratio =
          (1 - rate * static_cast<double>(lessons_.rates[e])) / (1 - rate * base);
      const double less = weight * (regret == 1 ? ratio : std::pow(ratio, regret));
      sum_ += less - weight;
      weight = less;
    }
  }

  std::vector<double> normalised() const {
    std::vector<double> shares(weights_);
    for (double &share : shares)
      share /= sum_;
    return shares;
  }

private:
  void learn(const RecallRun &run, int64_t j, double weight) {
    const int32_t node = run.nodes[j];
    if (node >= lessons_.nodes)
      return;
    const double factor = weight * (run.accepted[j] ? 1 : failure_weight(run, j));
    const float *gains = run.accepted[j] ? lessons_.on_success : lessons_.on_failure;
    for (int64_t e = lessons_.starts[node]; e < lessons_.starts[node + 1]; ++e)
      weights_[at(lessons_.viewers[e])] += factor * static_cast<double>(gains[e]);
  }

  const RecallLessons &lessons_;
  std::vector<double> weights_; // logarithms while learning
  double sum_ = 0;              // of the weights and that of being like none
};

// This run's decayed successes and failures by candidate: of its session, or of the very node.
struct Tallies {
  std::vector<double> successes, failures;

  double odds(int64_t row, double pseudo) const {
    return std::log((successes[at(row)] + pseudo) / (failures[at(row)] + pseudo));
  }
};

Tallies of_sessions(const RecallRun &run, const RecallCandidates &candidates, double memory_m) {
  std::vector<double> successes(at(candidates.session_count), 0), failures(successes);
  for (int64_t j = 0; j < run.count; ++j) {
    const double weight = std::exp(-run.ago_m[j] / memory_m);
    const size_t session = at(candidates.sessions[run.nodes[j]]);
    if (run.accepted[j])
      successes[session] += weight;
    else
      failures[session] += weight * failure_weight(run, j);
  }
  Tallies tallies;
  for (int64_t row = 0; row < candidates.count; ++row) {
    const size_t session = at(candidates.sessions[candidates.nodes[row]]);
    tallies.successes.push_back(successes[session]);
    tallies.failures.push_back(failures[session]);
  }
  return tallies;
}

Tallies of_nodes(const RecallRun &run, const RecallCandidates &candidates, double memory_m) {
  const std::vector<double> none(at(candidates.count), 0);
  Tallies tallies{none, none};
  const int32_t *end = candidates.nodes + candidates.count;
  for (int64_t j = 0; j < run.count; ++j) {
    const int32_t *found = std::find(candidates.nodes, end, run.nodes[j]);
    if (found == end)
      continue;
    const double weight = std::exp(-run.ago_m[j] / memory_m);
    const size_t row = at(found - candidates.nodes);
    if (run.accepted[j])
      tallies.successes[row] += weight;
    else
      tallies.failures[row] += weight * failure_weight(run, j);
  }
  return tallies;
}

class Picking {
public:
  Picking(const RecallLessons &lessons, const RecallRun &run, const double *prior,
          const RecallCandidates &candidates, const RecallConstants &constants)
      : lessons_(lessons), candidates_(candidates), constants_(constants),
        viewers_(lessons, run, prior, constants),
        own_(of_sessions(run, candidates, constants.own_m)) {
    const Tallies nodes = of_nodes(run, candidates, constants.node_m);
    judged.viewers = viewers_.normalised();
    const size_t count = at(candidates.count);
    judged.chances.resize(count);
    for (int64_t row = 0; row < candidates.count; ++row) {
      judged.company.push_back(company(row));
      judged.own.push_back(own_.odds(row, constants.pseudo));
      judged.node.push_back(nodes.odds(row, constants.pseudo));
      fixed_.push_back(candidates.fixed[row] + constants.node * judged.node.back());
      judge(row, judged.company.back());
    }
    judged.order.resize(count);
    std::iota(judged.order.begin(), judged.order.end(), int64_t{0});
    sort(0, candidates.count);
  }

  // The shortlist in the order of greedy picks, then by what is left of its chances.
  void pick() {
    std::vector<int64_t> &order = judged.order;
    const auto shortlist = std::min(constants_.shortlist, candidates_.count);
    const auto picks = std::min(constants_.picks, shortlist);
    // Back in the order of rows: of equals the first is preferred.
    std::sort(order.begin(), order.begin() + shortlist);
    for (int64_t place = 0; place < picks; ++place) {
      if (place > 0) {
        suppose_failure(order[at(place - 1)]);
        for (int64_t other = place; other < shortlist; ++other)
          judge(order[at(other)], company(order[at(other)]));
      }
      const auto best = std::max_element(
          order.begin() + place, order.begin() + shortlist, [&](int64_t a, int64_t b) {
            return judged.chances[at(a)] < judged.chances[at(b)];
          });
      std::rotate(order.begin() + place, best, best + 1);
    }
    sort(picks, shortlist);
  }

  RecallJudgement judged;

private:
  double base(int64_t row) const {
    const int32_t node = candidates_.nodes[row];
    return node < lessons_.nodes ? lessons_.base[node] : constants_.unknown_base;
  }

  double company(int64_t row) const { return viewers_.company(candidates_.nodes[row], base(row)); }

  void judge(int64_t row, double company) {
    const double odds = fixed_[at(row)] + constants_.company * log_odds(company) +
                        constants_.own * own_.odds(row, constants_.pseudo);
    judged.chances[at(row)] = 1 / (1 + std::exp(-odds));
  }

  void suppose_failure(int64_t row) {
    const double rate = std::clamp(candidates_.rates[row], 0.0, 1 - kLeastChance);
    viewers_.suppose_failure(candidates_.nodes[row], rate, base(row), constants_.regret);
    const int32_t session = candidates_.sessions[candidates_.nodes[row]];
    for (int64_t other = 0; other < candidates_.count; ++other)
      if (candidates_.sessions[candidates_.nodes[other]] == session)
        own_.failures[at(other)] += constants_.regret * rate;
  }

  void sort(int64_t from, int64_t to) {
    std::stable_sort(
        judged.order.begin() + from, judged.order.begin() + to,
        [&](int64_t a, int64_t b) { return judged.chances[at(a)] > judged.chances[at(b)]; });
  }

  const RecallLessons &lessons_;
  const RecallCandidates &candidates_;
  const RecallConstants &constants_;
  Viewers viewers_;
  Tallies own_;
  std::vector<double> fixed_;
};

} // namespace

RecallJudgement recall_order(const RecallLessons &lessons, const RecallRun &run,
                             const double *prior, const RecallCandidates &candidates,
                             const RecallConstants &constants) {
  Picking picking(lessons, run, prior, candidates, constants);
  picking.pick();
  return std::move(picking.judged);
}

} // namespace engram::ENGRAM_ISA
