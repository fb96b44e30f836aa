// Least uncertain chains through an experience graph (method §3.1).
//
// The error of an edge is a small rotation of variance v (rad², any axis) about a pivot, and a small
// translation of variance tau (m², any axis). Along a chain these add up, seen at a point p, to
//   variance(p) = sum of tau_i + v_i |p - pivot_i|²  =  tau + s2 - 2 p·s1 + s0 |p|²,
// with s0, s1, s2 the moments of v_i, so a chain's error is six numbers that add edge by edge.
#pragma once

#include <cstdint>
#include <vector>

#include "dispatch.hpp"

namespace engram {

// Forward star: edge e has the half edges 2e (from a to b) and 2e + 1 (from b to a). The half edges
// that leave a node are a list: first_half[node], then next_half[half], until -1. Those of a node that
// has not been loaded are `not_loaded`.
constexpr int32_t not_loaded = -2;

struct GraphView {
  int64_t node_count, edge_count;
  const int32_t *first_half; // (nodes)
  const int32_t *next_half;  // (2 edges)
  const int32_t *target;     // (2 edges) node at the far end
  const double *a_from_b;    // (edges, 12) rotation row by row, then translation
  const double *errors;      // (edges, 8) tau, v, pivot in a, pivot in b
};

struct ChainError {
  double tau = 0, s0 = 0, s1[3] = {0, 0, 0}, s2 = 0;
};

// A node that the search has reached by its least uncertain chain.
struct Reached {
  int32_t node;
  int32_t half; // the half edge it was reached by, -1 at the root
  int32_t parent; // row of the node before it, -1 at the root
  double cost;    // what the search minimises
  double root_from_node[12];
  ChainError error; // in the root's frame
};

// Which edges a search may use: those of a list, and others but those at some nodes.
struct Passage {
  const int32_t *edges; // ascending: always usable
  int64_t edge_count;
  const int32_t *closed; // ascending nodes, at which no other edge is usable; null closes all
  int64_t closed_count;
};

struct SearchLimits {
  const double *anchor;  // (3) in the root's frame: errors are weighed as seen there; or null
  double reach_m;        // nodes further than this from the anchor are not gone through,
  double slack_sigmas;   // plus so many standard deviations of where they are,
  double slack_m;        // but no more than this
  const Passage *passage; // or null: all edges are usable
  const int32_t *goals;  // (goal_count) ascending, each once: stop when all are reached
  int32_t goal_count;    // 0 to go on to the end
};

struct Candidates {
  std::vector<int32_t> nodes;
  std::vector<double> node_from_live; // (Y, 16)
  std::vector<double> distance_m, along_m, across_m, yaw_rad, sigma_m, sigma_yaw_rad;
  std::vector<double> pivot_in_node; // (Y, 3)
};

struct CandidateLimits {
  double radius_m = 0, margin_m = 0, view_gate_rad = 0, slack_sigmas = 0, slack_m = 0;
  // Where the chain to a node is vaguer than this, a better one is looked for that goes so much
  // further out: a vague chain may say that a node is near of which others know that it is not.
  double vague_m = 0, detour_m = 0;
  int32_t own_session = -1; // -1 for none
  double own_driven_m = 0, own_exclusion_m = 0;
};

struct CandidateQuery {
  int32_t reference;
  const double *reference_from_live; // (12)
  const double *live_error;          // (5) tau, v, pivot in the reference's frame
  CandidateLimits limits;
  const int32_t *sessions; // (nodes)
  const double *driven_m;  // (nodes)
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // tau, v and the pivot (3) of a covariance (6, 6), left perturbation, [translation, rotation]:
    // the pivot is where the translational error is smallest.
    void pivoted_error(const double *covariance, double *error);

    // Variance of the position along its least certain axis, by the same covariance.
    double greatest_variance(const double *covariance);

    // Every node within the limits, in the order in which the search settles them: least uncertain
    // first, ties by node index. Throws std::invalid_argument when the arrays are inconsistent.
    // `absent` are the nodes that it would have to go through and that have not been loaded: with any,
    // the result is not to be used.
    void search_chains(const GraphView &graph, int32_t root, const SearchLimits &limits,
                       std::vector<Reached> &reached, std::vector<int32_t> &absent);

    // The candidates near the live camera, and likewise the absent nodes.
    void find_candidates(const GraphView &graph, const CandidateQuery &query, Candidates &found,
                         std::vector<int32_t> &absent);)
