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
  const float *rates;      // how likely the viewer matches the node
  const float *on_success; // log(rate / base): what a success here says for being like the viewer
  const float *on_failure; // log((1 - rate) / (1 - base)): what a failure says
  const double *base;      // (nodes) how likely anybody does
  int64_t nodes, viewer_count;
};

// What this run attempted lately.
struct RecallRun {
  const int32_t *nodes;
  const double *ago_m; // metres driven since, not negative
  const double *rates; // g at the predicted offset; NaN where there was no prediction
  const bool *accepted;
  int64_t count;
};

// The candidates, nearest first: of equals the first is preferred.
struct RecallCandidates {
  const int32_t *nodes;
  const double *rates; // g(d)
  const double *fixed; // log odds from what is not worked out here
  int64_t count;
  const int32_t *sessions; // (graph_nodes) which session saved each node of the graph
  int64_t graph_nodes, session_count;
};

struct RecallConstants {
  double company, own, node;       // factors of three terms of the log odds
  double own_m, node_m, viewers_m; // memories
  double trust;                    // what evidence of one attempt counts for in weighing viewers
  double nobody;                   // weight of "like none of them"
  double unknown_base;             // how likely anybody matches a node that taught nothing
  double pseudo;                   // pseudo-count of the tallies
  double regret;                   // how much a pick counts as failed once it is picked
  int64_t picks;                   // how many picks are made greedily
  int64_t shortlist;               // among how many
};

struct RecallJudgement {
  std::vector<int64_t> order;
  // By row of the candidates: the chance as it was picked, or at the end; at first, the share of
  // like-minded viewers that match it and the log odds of this run's tallies.
  std::vector<double> chances, company, own, node;
  std::vector<double> viewers; // weights at first, adding up to 1 with "none of them"
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // `prior`: (viewer_count) log weights before any evidence; -inf leaves a viewer out.
    RecallJudgement recall_order(const RecallLessons &lessons, const RecallRun &run,
                                 const double *prior, const RecallCandidates &candidates,
                                 const RecallConstants &constants);)
