#include "kernels/graph_search.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

namespace engram::ENGRAM_ISA {
namespace {

// What a rotation error costs besides what it does at the anchor: landmarks lie some 10 m away.
constexpr double lever_m = 10;

double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

double squared_distance(const double *a, const double *b) {
  const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
  return dot(d, d);
}

void transform_point(const double *pose, const double *point, double *out) {
  for (int i = 0; i < 3; ++i)
    out[i] = dot(pose + 3 * i, point) + pose[9 + i];
}

void compose(const double *a_from_b, const double *b_from_c, double *a_from_c) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      a_from_c[3 * i + j] = a_from_b[3 * i] * b_from_c[j] + a_from_b[3 * i + 1] * b_from_c[3 + j] +
                            a_from_b[3 * i + 2] * b_from_c[6 + j];
  transform_point(a_from_b, b_from_c + 9, a_from_c + 9);
}

// a_from_b⁻¹ @ a_from_c
void compose_inverse(const double *a_from_b, const double *a_from_c, double *b_from_c) {
  const double offset[3] = {a_from_c[9] - a_from_b[9], a_from_c[10] - a_from_b[10],
                            a_from_c[11] - a_from_b[11]};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j)
      b_from_c[3 * i + j] = a_from_b[i] * a_from_c[j] + a_from_b[3 + i] * a_from_c[3 + j] +
                            a_from_b[6 + i] * a_from_c[6 + j];
    b_from_c[9 + i] =
        a_from_b[i] * offset[0] + a_from_b[3 + i] * offset[1] + a_from_b[6 + i] * offset[2];
  }
}

void add_error(ChainError &sum, double tau, double v, const double *pivot) {
  sum.tau += tau;
  sum.s0 += v;
  for (int i = 0; i < 3; ++i)
    sum.s1[i] += v * pivot[i];
  sum.s2 += v * dot(pivot, pivot);
}

double variance_at(const ChainError &error, const double *point) {
  const double variance =
      error.tau + error.s2 - 2 * dot(error.s1, point) + error.s0 * dot(point, point);
  return std::max(variance, error.tau);
}

struct Open {
  double cost;
  int32_t node;
  // Heaps of the standard library have the greatest on top: the order is turned around.
  bool operator<(const Open &other) const {
    return cost != other.cost ? cost > other.cost : node > other.node;
  }
};

// Which nodes a search has seen. Kept between searches, so that none touches the whole map.
struct Scratch {
  std::vector<int32_t> row_of; // per node: row in `reached`, -1 if not seen
  std::vector<uint8_t> settled;
  std::vector<Open> heap;
};

thread_local Scratch scratch;

class Search {
public:
  Search(const GraphView &graph, const SearchLimits &limits, std::vector<Reached> &seen)
      : graph_(graph), limits_(limits), seen_(seen) {
    if (scratch.row_of.size() < static_cast<size_t>(graph.node_count))
      scratch.row_of.resize(static_cast<size_t>(graph.node_count), -1);
    scratch.heap.clear();
    scratch.settled.clear();
    seen_.clear();
  }
  ~Search() {
    for (const Reached &row : seen_)
      scratch.row_of[static_cast<size_t>(row.node)] = -1;
  }
  Search(const Search &) = delete;
  Search &operator=(const Search &) = delete;

  // Rows of `seen` in the order in which they were settled.
  std::vector<int32_t> run(int32_t root) {
    std::vector<int32_t> order;
    start(root);
    while (!scratch.heap.empty()) {
      std::pop_heap(scratch.heap.begin(), scratch.heap.end());
      const int32_t node = scratch.heap.back().node;
      scratch.heap.pop_back();
      const int32_t row = scratch.row_of[static_cast<size_t>(node)];
      if (scratch.settled[static_cast<size_t>(row)])
        continue;
      settle(row);
      order.push_back(row);
      if (node == limits_.goal)
        break;
      if (within_reach(row))
        expand(row);
    }
    return order;
  }

private:
  void start(int32_t root) {
    Reached row{};
    row.node = root;
    row.half = row.parent = -1;
    row.root_from_node[0] = row.root_from_node[4] = row.root_from_node[8] = 1;
    seen_.push_back(row);
    scratch.settled.push_back(0);
    scratch.row_of[static_cast<size_t>(root)] = 0;
    scratch.heap.push_back({0, root});
  }

  // Poses and errors are worked out once, when the chain to a node is final.
  void settle(int32_t row) {
    scratch.settled[static_cast<size_t>(row)] = 1;
    Reached &here = seen_[static_cast<size_t>(row)];
    if (here.parent < 0)
      return;
    const Reached &before = seen_[static_cast<size_t>(here.parent)];
    const double *a_from_b = graph_.a_from_b + 12 * (here.half / 2);
    if (here.half % 2 == 0) {
      compose(before.root_from_node, a_from_b, here.root_from_node);
    } else {
      const double identity[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0};
      double b_from_a[12];
      compose_inverse(a_from_b, identity, b_from_a);
      compose(before.root_from_node, b_from_a, here.root_from_node);
    }
    const double *error = graph_.errors + 8 * (here.half / 2);
    double pivot[3];
    transform_point(before.root_from_node, error + (here.half % 2 == 0 ? 2 : 5), pivot);
    here.error = before.error;
    add_error(here.error, error[0], error[1], pivot);
  }

  bool within_reach(int32_t row) const {
    if (limits_.anchor == nullptr)
      return true;
    const Reached &here = seen_[static_cast<size_t>(row)];
    const double square = squared_distance(here.root_from_node + 9, limits_.anchor);
    if (square <= limits_.reach_m * limits_.reach_m)
      return true;
    const double sigma = std::sqrt(variance_at(here.error, limits_.anchor));
    const double reach =
        limits_.reach_m + std::min(limits_.slack_sigmas * sigma, limits_.slack_m);
    return square <= reach * reach;
  }

  void expand(int32_t row) {
    const int32_t node = seen_[static_cast<size_t>(row)].node;
    for (int32_t half = graph_.first_half[node]; half != -1; half = graph_.next_half[half]) {
      // Each half edge leaves one node, and each node is expanded once.
      if (half < 0 || half >= 2 * graph_.edge_count || ++half_edges_ > 2 * graph_.edge_count)
        throw std::invalid_argument("forward star: a half edge is out of range or in a cycle");
      const int32_t target = graph_.target[half];
      if (target < 0 || target >= graph_.node_count)
        throw std::invalid_argument("forward star: an edge leads to a node that is not there");
      if (limits_.usable == nullptr || limits_.usable[half / 2])
        relax(row, half, target);
    }
  }

  void relax(int32_t row, int32_t half, int32_t target) {
    const int32_t known = scratch.row_of[static_cast<size_t>(target)];
    if (known >= 0 && scratch.settled[static_cast<size_t>(known)])
      return;
    const double cost = seen_[static_cast<size_t>(row)].cost + edge_cost(row, half);
    if (known >= 0 && cost >= seen_[static_cast<size_t>(known)].cost)
      return;
    Reached *there = nullptr;
    if (known >= 0) {
      there = &seen_[static_cast<size_t>(known)];
    } else {
      scratch.row_of[static_cast<size_t>(target)] = static_cast<int32_t>(seen_.size());
      seen_.emplace_back();
      scratch.settled.push_back(0);
      there = &seen_.back();
      there->node = target;
    }
    there->half = half;
    there->parent = row;
    there->cost = cost;
    scratch.heap.push_back({cost, target});
    std::push_heap(scratch.heap.begin(), scratch.heap.end());
  }

  double edge_cost(int32_t row, int32_t half) const {
    const double *error = graph_.errors + 8 * (half / 2);
    double lever = lever_m * lever_m;
    if (limits_.anchor != nullptr) {
      double pivot[3];
      transform_point(seen_[static_cast<size_t>(row)].root_from_node,
                      error + (half % 2 == 0 ? 2 : 5), pivot);
      lever += squared_distance(pivot, limits_.anchor);
    }
    return error[0] + error[1] * lever;
  }

  const GraphView &graph_;
  const SearchLimits &limits_;
  std::vector<Reached> &seen_;
  int64_t half_edges_ = 0;
};

bool is_own_recent(const CandidateQuery &query, int32_t node) {
  return query.own_session >= 0 && query.sessions[node] == query.own_session &&
         query.own_driven_m - query.driven_m[node] < query.own_exclusion_m;
}

// The point about which the chain's rotation errors balance, or the live camera if there are none.
void mean_pivot(const ChainError &error, const double *live, double *pivot) {
  for (int i = 0; i < 3; ++i)
    pivot[i] = error.s0 > 0 ? error.s1[i] / error.s0 : live[i];
}

void add_candidate(const CandidateQuery &query, const Reached &row, Candidates &found) {
  double node_from_live[12];
  compose_inverse(row.root_from_node, query.reference_from_live, node_from_live);
  const double *offset = node_from_live + 9;
  ChainError error = row.error;
  add_error(error, query.live_error[0], query.live_error[1], query.live_error + 2);
  const double *live = query.reference_from_live + 9;
  const double sigma = std::sqrt(variance_at(error, live)), sigma_yaw = std::sqrt(error.s0);
  const double distance = std::sqrt(dot(offset, offset));
  const double yaw = std::atan2(node_from_live[2], node_from_live[8]);
  if (distance > query.radius_m + std::min(query.slack_sigmas * sigma, query.slack_m) ||
      std::abs(yaw) > query.view_gate_rad + query.slack_sigmas * sigma_yaw)
    return;
  double pivot_in_reference[3];
  mean_pivot(error, live, pivot_in_reference);
  const double reference_from_pivot[12] = {
      1, 0, 0, 0, 1, 0, 0, 0, 1, pivot_in_reference[0], pivot_in_reference[1],
      pivot_in_reference[2]};
  double node_from_pivot[12];
  compose_inverse(row.root_from_node, reference_from_pivot, node_from_pivot);
  found.nodes.push_back(row.node);
  for (int i = 0; i < 3; ++i) {
    found.node_from_live.insert(found.node_from_live.end(), node_from_live + 3 * i,
                                node_from_live + 3 * i + 3);
    found.node_from_live.push_back(offset[i]);
  }
  found.node_from_live.insert(found.node_from_live.end(), {0, 0, 0, 1});
  found.distance_m.push_back(distance);
  found.along_m.push_back(offset[2]);
  found.across_m.push_back(offset[0]);
  found.yaw_rad.push_back(yaw);
  found.sigma_m.push_back(sigma);
  found.sigma_yaw_rad.push_back(sigma_yaw);
  found.pivot_in_node.insert(found.pivot_in_node.end(), node_from_pivot + 9, node_from_pivot + 12);
}

} // namespace

void search_chains(const GraphView &graph, int32_t root, const SearchLimits &limits,
                   std::vector<Reached> &reached) {
  std::vector<Reached> seen;
  std::vector<int32_t> order, place;
  {
    Search search(graph, limits, seen);
    order = search.run(root);
  }
  place.assign(seen.size(), -1);
  reached.clear();
  reached.reserve(order.size());
  for (const int32_t row : order) {
    place[static_cast<size_t>(row)] = static_cast<int32_t>(reached.size());
    reached.push_back(seen[static_cast<size_t>(row)]);
    if (reached.back().parent >= 0)
      reached.back().parent = place[static_cast<size_t>(reached.back().parent)];
  }
}

void find_candidates(const GraphView &graph, const CandidateQuery &query, Candidates &found) {
  // The reference may lie behind, after a while on odometry alone: reach at least as far as it.
  const double *live = query.reference_from_live + 9;
  const double reach = std::max(query.radius_m, std::sqrt(dot(live, live))) + query.margin_m;
  const SearchLimits limits{live, reach, query.slack_sigmas, query.slack_m, nullptr, -1};
  static thread_local std::vector<Reached> seen;
  std::vector<int32_t> order;
  {
    Search search(graph, limits, seen);
    order = search.run(query.reference);
  }
  for (const int32_t row : order)
    if (!is_own_recent(query, seen[static_cast<size_t>(row)].node))
      add_candidate(query, seen[static_cast<size_t>(row)], found);
}

} // namespace engram::ENGRAM_ISA
