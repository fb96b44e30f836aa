// Γ(recall): which candidates to attempt, judged by what past drives matched and failed here.
#pragma once

#include <cstdint>
#include <vector>

#include "dispatch.hpp"

namespace engram {

// Row n: what past drives ("viewers") learnt at node n. Nodes beyond `nodes` taught nothing yet.
struct RecallLessons {
  const int64_t *starts; // (nodes + 1)
  const int32_t *viewers;
  const float *rates;       // how likely the viewer matches the node
  const float *on_success;  // log(rate / base): what a success here says for being like the viewer
  const float *on_failure;  // log((1 - rate) / (1 - base)): what a failure says
  const double *base;       // (nodes) how likely anybody does
  int64_t nodes, viewer_count;
};

// What this run attempted lately.
struct RecallRun {
  const int32_t *nodes;
  const double *successes, *failures; // weights, of which one is 0
  int64_t count;
};

// The candidates, nearest first: of equals the first is preferred.
struct RecallCandidates {
  const int32_t *nodes, *groups; // groups: the session that saved each
  const double *rates;           // g(d)
  const double *fixed;           // log odds from all that does not change with a pick
  const double *successes, *failures; // this run's tallies of the candidate's session
  int64_t count;
};

struct RecallConstants {
  double trust;        // what evidence of one attempt counts for in weighing viewers
  double nobody;       // weight of "like none of them"
  double unknown_base; // how likely anybody matches a node that taught nothing
  double company, own; // factors of two terms of the log odds
  double pseudo;       // pseudo-count of the tallies
  double regret;       // how much a pick counts as failed once it is picked
  int64_t picks;       // how many picks are made greedily
  int64_t shortlist;   // among how many
};

struct RecallJudgement {
  std::vector<int64_t> order;
  std::vector<double> chances;  // by row: as it was picked, or at the end
  std::vector<double> company;  // by row: share of like-minded viewers that match it, at first
  std::vector<double> viewers;  // by viewer: weight at first, adding up to 1 with "none of them"
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // `prior`: (viewer_count) log weights before any evidence; -inf leaves a viewer out.
    RecallJudgement recall_order(const RecallLessons &lessons, const RecallRun &run,
                                 const double *prior, const RecallCandidates &candidates,
                                 const RecallConstants &constants);)
