#include "kernels/graph_search.hpp"

#include <algorithm>
#include <array>
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
  Search(const GraphView &graph, const SearchLimits &limits, std::vector<Reached> &seen,
         std::vector<int32_t> &absent)
      : graph_(graph), limits_(limits), seen_(seen), absent_(absent) {
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
    int32_t goals_left = limits_.goal_count;
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
      if (is_goal(node) && --goals_left == 0)
        break;
      if (within_reach(row))
        expand(row);
    }
    return order;
  }

private:
  bool is_goal(int32_t node) const {
    return std::binary_search(limits_.goals, limits_.goals + limits_.goal_count, node);
  }

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
    if (graph_.first_half[node] == not_loaded) {
      absent_.push_back(node);
      return;
    }
    for (int32_t half = graph_.first_half[node]; half != -1; half = graph_.next_half[half]) {
      // Each half edge leaves one node, and each node is expanded once.
      if (half < 0 || half >= 2 * graph_.edge_count || ++half_edges_ > 2 * graph_.edge_count)
        throw std::invalid_argument("forward star: a half edge is out of range or in a cycle");
      const int32_t target = graph_.target[half];
      if (target < 0 || target >= graph_.node_count)
        throw std::invalid_argument("forward star: an edge leads to a node that is not there");
      if (limits_.passage == nullptr || usable(*limits_.passage, half / 2, node, target))
        relax(row, half, target);
    }
  }

  static bool usable(const Passage &passage, int32_t edge, int32_t a, int32_t b) {
    const auto holds = [](const int32_t *first, int64_t count, int32_t value) {
      return std::binary_search(first, first + count, value);
    };
    return (passage.closed != nullptr && !holds(passage.closed, passage.closed_count, a) &&
            !holds(passage.closed, passage.closed_count, b)) ||
           holds(passage.edges, passage.edge_count, edge);
  }

  void relax(int32_t row, int32_t half, int32_t target) {
    const int32_t known = scratch.row_of[static_cast<size_t>(target)];
    if (known >= 0 && scratch.settled[static_cast<size_t>(known)])
      return;
    const double *error = graph_.errors + 8 * (half / 2);
    const double least =
        seen_[static_cast<size_t>(row)].cost + error[0] + error[1] * lever_m * lever_m;
    if (known >= 0 && least >= seen_[static_cast<size_t>(known)].cost)
      return; // without working out where the pivot is
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
  std::vector<int32_t> &absent_;
  int64_t half_edges_ = 0;
};

bool is_own_recent(const CandidateQuery &query, int32_t node) {
  const CandidateLimits &limits = query.limits;
  return limits.own_session >= 0 && query.sessions[node] == limits.own_session &&
         limits.own_driven_m - query.driven_m[node] < limits.own_exclusion_m;
}

// The point about which the chain's rotation errors balance, or the live camera if there are none.
void mean_pivot(const ChainError &error, const double *live, double *pivot) {
  for (int i = 0; i < 3; ++i)
    pivot[i] = error.s0 > 0 ? error.s1[i] / error.s0 : live[i];
}

// A node as seen from the live camera, and how well that is known.
struct Sight {
  double node_from_live[12];
  ChainError error;
  double distance, sigma, yaw, sigma_yaw;
};

Sight sight_of(const CandidateQuery &query, const Reached &row) {
  Sight sight;
  compose_inverse(row.root_from_node, query.reference_from_live, sight.node_from_live);
  sight.error = row.error;
  add_error(sight.error, query.live_error[0], query.live_error[1], query.live_error + 2);
  const double *offset = sight.node_from_live + 9;
  sight.distance = std::sqrt(dot(offset, offset));
  sight.sigma = std::sqrt(variance_at(sight.error, query.reference_from_live + 9));
  sight.yaw = std::atan2(sight.node_from_live[2], sight.node_from_live[8]);
  sight.sigma_yaw = std::sqrt(sight.error.s0);
  return sight;
}

bool may_be_near(const CandidateQuery &query, const Sight &sight) {
  const CandidateLimits &limits = query.limits;
  return sight.distance <=
             limits.radius_m + std::min(limits.slack_sigmas * sight.sigma, limits.slack_m) &&
         std::abs(sight.yaw) <= limits.view_gate_rad + limits.slack_sigmas * sight.sigma_yaw;
}

void add_candidate(const CandidateQuery &query, const Reached &row, Candidates &found) {
  const Sight sight = sight_of(query, row);
  if (!may_be_near(query, sight))
    return;
  const double *offset = sight.node_from_live + 9;
  double pivot_in_reference[3];
  mean_pivot(sight.error, query.reference_from_live + 9, pivot_in_reference);
  const double reference_from_pivot[12] = {
      1, 0, 0, 0, 1, 0, 0, 0, 1, pivot_in_reference[0], pivot_in_reference[1],
      pivot_in_reference[2]};
  double node_from_pivot[12];
  compose_inverse(row.root_from_node, reference_from_pivot, node_from_pivot);
  found.nodes.push_back(row.node);
  for (int i = 0; i < 3; ++i) {
    found.node_from_live.insert(found.node_from_live.end(), sight.node_from_live + 3 * i,
                                sight.node_from_live + 3 * i + 3);
    found.node_from_live.push_back(offset[i]);
  }
  found.node_from_live.insert(found.node_from_live.end(), {0, 0, 0, 1});
  found.distance_m.push_back(sight.distance);
  found.along_m.push_back(offset[2]);
  found.across_m.push_back(offset[0]);
  found.yaw_rad.push_back(sight.yaw);
  found.sigma_m.push_back(sight.sigma);
  found.sigma_yaw_rad.push_back(sight.sigma_yaw);
  found.pivot_in_node.insert(found.pivot_in_node.end(), node_from_pivot + 9, node_from_pivot + 12);
}

using Symmetric = std::array<double, 9>;

double trace(const Symmetric &m) { return m[0] + m[4] + m[8]; }

double determinant(const double *a, const double *b, const double *c) {
  return a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) +
         a[2] * (b[0] * c[1] - b[1] * c[0]);
}

// Largest eigenvalue of a symmetric 3×3 matrix, in closed form (Smith 1961).
double largest_eigenvalue(const Symmetric &m) {
  const double mean = trace(m) / 3;
  Symmetric centred = m;
  for (int i = 0; i < 9; i += 4)
    centred[static_cast<size_t>(i)] -= mean;
  double square = 0;
  for (const double value : centred)
    square += value * value;
  const double spread = std::sqrt(square / 6);
  if (!(spread > 1e-150)) // below, its square has underflown
    return mean;
  for (double &value : centred)
    value /= spread;
  const double *rows = centred.data();
  const double ratio = determinant(rows, rows + 3, rows + 6) / 2;
  return mean + 2 * spread * std::cos(std::acos(std::clamp(ratio, -1.0, 1.0)) / 3);
}

Symmetric block(const double *covariance, int row, int column) {
  Symmetric out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out[static_cast<size_t>(3 * i + j)] = covariance[6 * (row + i) + column + j];
  return out;
}

// The point p where the trace of cov(t + r × p) = pᵀ A p - 2 g·p + const is smallest, with
// A = tr(R) I - R and R the covariance of r. About one axis only, p is free along it, and the
// little that is added to A takes the one nearest to the origin.
void quietest_point(const Symmetric &rotation, const Symmetric &cross, double *point) {
  const double scale = trace(rotation);
  point[0] = point[1] = point[2] = 0;
  if (!(scale > 1e-18))
    return;
  const double g[3] = {cross[5] - cross[7], cross[6] - cross[2], cross[1] - cross[3]};
  Symmetric a;
  for (size_t i = 0; i < 9; ++i)
    a[i] = (i % 4 == 0 ? scale * (1 + 1e-9) : 0) - rotation[i];
  const double whole = determinant(a.data(), a.data() + 3, a.data() + 6);
  point[0] = determinant(g, a.data() + 3, a.data() + 6) / whole;
  point[1] = determinant(a.data(), g, a.data() + 6) / whole;
  point[2] = determinant(a.data(), a.data() + 3, g) / whole;
}

} // namespace

void pivoted_error(const double *covariance, double *error) {
  const Symmetric rotation = block(covariance, 3, 3), cross = block(covariance, 3, 0);
  double *p = error + 2;
  quietest_point(rotation, cross, p);
  // cov(t - [p]× r) = T - [p]× X - ([p]× X)ᵀ + [p]× R [p]×ᵀ, with X = cov(r, t).
  const Symmetric lever = {0, -p[2], p[1], p[2], 0, -p[0], -p[1], p[0], 0};
  Symmetric at_pivot = block(covariance, 0, 0);
  for (size_t i = 0; i < 3; ++i)
    for (size_t j = 0; j < 3; ++j)
      for (size_t k = 0; k < 3; ++k) {
        at_pivot[3 * i + j] -= lever[3 * i + k] * cross[3 * k + j];
        at_pivot[3 * i + j] -= lever[3 * j + k] * cross[3 * k + i];
        for (size_t l = 0; l < 3; ++l)
          at_pivot[3 * i + j] += lever[3 * i + k] * rotation[3 * k + l] * lever[3 * j + l];
      }
  error[0] = std::max(largest_eigenvalue(at_pivot), 0.0);
  error[1] = std::max(largest_eigenvalue(rotation), 0.0);
}

double greatest_variance(const double *covariance) {
  return std::max(largest_eigenvalue(block(covariance, 0, 0)), 0.0);
}

void search_chains(const GraphView &graph, int32_t root, const SearchLimits &limits,
                   std::vector<Reached> &reached, std::vector<int32_t> &absent) {
  std::vector<Reached> seen;
  std::vector<int32_t> order, place;
  {
    Search search(graph, limits, seen, absent);
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

void find_candidates(const GraphView &graph, const CandidateQuery &query, Candidates &found,
                     std::vector<int32_t> &absent) {
  // The reference may lie behind, after a while on odometry alone: reach at least as far as it.
  const double *live = query.reference_from_live + 9;
  const CandidateLimits &asked = query.limits;
  const double reach = std::max(asked.radius_m, std::sqrt(dot(live, live))) + asked.margin_m;
  SearchLimits limits{live, reach, asked.slack_sigmas, asked.slack_m, nullptr, nullptr, 0};
  static thread_local std::vector<Reached> near, wide;
  std::vector<const Reached *> chains;
  std::vector<int32_t> vague;
  {
    Search search(graph, limits, near, absent);
    for (const int32_t row : search.run(query.reference)) {
      const Reached &chain = near[static_cast<size_t>(row)];
      if (variance_at(chain.error, live) <= asked.vague_m * asked.vague_m)
        chains.push_back(&chain);
      else if (may_be_near(query, sight_of(query, chain)))
        vague.push_back(chain.node);
    }
  }
  if (!vague.empty()) {
    std::sort(vague.begin(), vague.end());
    limits.reach_m += asked.detour_m;
    limits.goals = vague.data();
    limits.goal_count = static_cast<int32_t>(vague.size());
    Search search(graph, limits, wide, absent);
    for (const int32_t row : search.run(query.reference)) {
      const Reached &chain = wide[static_cast<size_t>(row)];
      if (std::binary_search(vague.begin(), vague.end(), chain.node))
        chains.push_back(&chain);
    }
    std::sort(chains.begin(), chains.end(), [](const Reached *a, const Reached *b) {
      return a->cost != b->cost ? a->cost < b->cost : a->node < b->node;
    });
  }
  found.node_from_live.reserve(16 * chains.size());
  for (const Reached *chain : chains) {
    if (graph.first_half[chain->node] == not_loaded)
      absent.push_back(chain->node);
    else if (!is_own_recent(query, chain->node))
      add_candidate(query, *chain, found);
  }
}

} // namespace engram::ENGRAM_ISA
