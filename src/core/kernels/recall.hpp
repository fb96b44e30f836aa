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
  const int32_t *sessions;  // that saved them
  const double *distance_m; // to the node; NaN where there was no prediction
  const double *rates;      // how likely a match was; NaN likewise
  const uint8_t *accepted;
  const int64_t *inliers;
  int64_t count;
};

// The candidates, nearest first: of equals the first is preferred.
struct RecallCandidates {
  const int32_t *nodes;
  const int32_t *sessions; // that saved them
  const double *costs; // margin lost by distance, but for what looks win
  const double *prior; // margin at no distance as past drives have it
  int64_t count;
};

// See `RecallConstants` in engram/ranking/recall.py for those that are named alike.
struct RecallConstants {
  double per_m = 0; // margin lost per metre
  double level = 0;
  double memory_m = 0;
  double prior_weight = 0;
  double regret = 0;
  double tally = 0, tally_memory_m = 0;
  double untried_rate = 0;     // of a session, and
  double untried_attempts = 0; // how many attempts that is worth
  int64_t needed = 0;          // fewest inliers of a match
  int64_t attempts = 0;        // how many of the run's newest are enough
  int64_t picks = 0;           // how many picks are made greedily
  int64_t shortlist = 0;       // among how many
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
