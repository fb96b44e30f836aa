// Γ(recall): which candidates to attempt, judged by what this run and past drives matched.
#pragma once

#include <cstdint>
#include <vector>

#include "dispatch.hpp"

namespace engram {

// What this run attempted, oldest first.
struct RecallRun {
  double driven_m;
  const double *at_m;       // driven when each was made
  const int32_t *nodes;
  const double *distance_m; // to the node; NaN where there was no prediction
  const double *rates;      // how likely a match was; NaN likewise
  const uint8_t *accepted;
  const int64_t *inliers;
  int64_t count;
};

// The candidates, nearest first: of equals the first is preferred.
struct RecallCandidates {
  const int32_t *nodes;
  const double *costs; // margin lost by distance, but for what looks win
  const double *prior; // margin at no distance as past drives have it
  int64_t count;
  const int32_t *sessions; // (graph_nodes) which session saved each node of the graph
  int64_t graph_nodes, session_count;
};

// See `RecallConstants` in engram/ranking/recall.py for those that are named alike.
struct RecallConstants {
  double per_m; // margin lost per metre
  double level;
  double memory_m;
  double prior_weight;
  double regret;
  double tally, tally_memory_m;
  double untried_rate;  // of a session, and
  double untried_count; // how many attempts that is worth
  int64_t needed;       // fewest inliers of a match
  int64_t attempts;     // how many of the run's newest are enough
  int64_t picks;        // how many picks are made greedily
  int64_t shortlist;    // among how many
};

struct RecallJudgement {
  std::vector<int64_t> order;
  // By row of the candidates: the margin as it was picked, or at the end; before any pick; and what
  // of it is the tally's.
  std::vector<double> margins, first, tally;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    RecallJudgement recall_order(const RecallRun &run, const RecallCandidates &candidates,
                                 const RecallConstants &constants);)
