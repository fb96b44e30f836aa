// Γ(recall): which candidates to attempt, judged by what this run and past drives matched.
#pragma once

#include <cstdint>
#include <vector>

#include "dispatch.hpp"

namespace engram {

// What this run attempted lately.
struct RecallRun {
  const int32_t *nodes;
  const double *ago_m;   // metres driven since, not negative
  const double *margins; // what each would have come to at no distance; NaN where nobody knows
  int64_t count;
};

// The candidates, nearest first: of equals the first is preferred.
struct RecallCandidates {
  const int32_t *nodes;
  const double *costs; // margin lost by distance
  const double *prior; // margin at no distance as past drives have it
  int64_t count;
  const int32_t *sessions; // (graph_nodes) which session saved each node of the graph
  int64_t graph_nodes, session_count;
};

struct RecallConstants {
  double memory_m;     // of this run's attempts
  double prior_weight; // how many attempts of this very moment the prior is worth
  double failed;       // margin of a pick that is supposed to have failed
  double regret;       // how many attempts of this very moment such a pick counts as
  int64_t picks;       // how many picks are made greedily
  int64_t shortlist;   // among how many
};

struct RecallJudgement {
  std::vector<int64_t> order;
  // By row of the candidates: the margin as it was picked, or at the end, and before any pick.
  std::vector<double> margins, first;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    RecallJudgement recall_order(const RecallRun &run, const RecallCandidates &candidates,
                                 const RecallConstants &constants);)
