#include "kernels/graph_search.hpp"

#include "bindings/arrays.hpp"

#include <cmath>
#include <limits>

#include <nanobind/stl/optional.h>

#include <algorithm>
#include <optional>
#include <stdexcept>

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Input;

// Holds on to a graph's arrays; checked once, so that the searches need not.
struct Graph {
  Input<int32_t, 1> first_half, next_half, target;
  Input<double, 2> a_from_b, errors;
  Input<int32_t, 1> sessions;
  Input<double, 1> driven_m;

  Graph(Input<int32_t, 1> first_half, Input<int32_t, 1> next_half, Input<int32_t, 1> target,
        Input<double, 2> a_from_b, Input<double, 2> errors, Input<int32_t, 1> sessions,
        Input<double, 1> driven_m)
      : first_half(first_half), next_half(next_half), target(target), a_from_b(a_from_b),
        errors(errors), sessions(sessions), driven_m(driven_m) {
    const size_t nodes = first_half.shape(0), edges = a_from_b.shape(0);
    if (next_half.shape(0) != 2 * edges || target.shape(0) != 2 * edges ||
        errors.shape(0) != edges || a_from_b.shape(1) != 12 || errors.shape(1) != 8 ||
        sessions.shape(0) != nodes || driven_m.shape(0) != nodes)
      throw std::invalid_argument(
          "graph arrays: expected next_half and target (2E,), a_from_b (E, 12), errors (E, 8), "
          "sessions and driven_m as long as first_half (N,)");
  }

  engram::GraphView view() const {
    return {static_cast<int64_t>(first_half.shape(0)),
            static_cast<int64_t>(a_from_b.shape(0)),
            first_half.data(),
            next_half.data(),
            target.data(),
            a_from_b.data(),
            errors.data()};
  }
};

void check_node(const engram::GraphView &graph, int64_t node, const char *name) {
  if (node < 0 || node >= graph.node_count)
    throw std::invalid_argument(std::string(name) + " " + std::to_string(node) +
                                ": the graph has " + std::to_string(graph.node_count) + " nodes");
}

// (None, nodes to load): what a search returns that came to nodes that have not been loaded.
nb::tuple lacking(std::vector<int32_t> &&absent) {
  const size_t count = absent.size();
  return nb::make_tuple(nb::none(), engram::to_numpy(std::move(absent), {count}));
}

auto graph_candidates(const Graph &arrays, int64_t reference,
                      const Input<double, 1> &reference_from_live,
                      const Input<double, 1> &live_error, const engram::CandidateLimits &limits) {
  const engram::GraphView graph = arrays.view();
  check_node(graph, reference, "reference");
  if (reference_from_live.shape(0) != 12 || live_error.shape(0) != 5)
    throw std::invalid_argument(
        "graph_candidates: expected reference_from_live (12,) and live_error (5,)");
  const engram::CandidateQuery query{static_cast<int32_t>(reference),
                                     reference_from_live.data(),
                                     live_error.data(),
                                     limits,
                                     arrays.sessions.data(),
                                     arrays.driven_m.data()};
  engram::Candidates found;
  std::vector<int32_t> absent;
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(find_candidates, graph, query, found, absent);
  }
  if (!absent.empty())
    return lacking(std::move(absent));
  const size_t count = found.nodes.size();
  return nb::make_tuple(nb::make_tuple(engram::to_numpy(std::move(found.nodes), {count}),
                        engram::to_numpy(std::move(found.node_from_live), {count, 4, 4}),
                        engram::to_numpy(std::move(found.distance_m), {count}),
                        engram::to_numpy(std::move(found.along_m), {count}),
                        engram::to_numpy(std::move(found.across_m), {count}),
                        engram::to_numpy(std::move(found.yaw_rad), {count}),
                        engram::to_numpy(std::move(found.sigma_m), {count}),
                        engram::to_numpy(std::move(found.sigma_yaw_rad), {count}),
                        engram::to_numpy(std::move(found.pivot_in_node), {count, 3})), nb::none());
}

auto graph_chains(const Graph &arrays, int64_t root, const Input<int32_t, 1> &goals,
                  std::optional<Input<int32_t, 1>> edges,
                  std::optional<Input<int32_t, 1>> closed) {
  const engram::GraphView graph = arrays.view();
  check_node(graph, root, "root");
  if (!edges && closed)
    throw std::invalid_argument("graph_chains: closed nodes need a list of usable edges");
  for (const auto &list : {edges, closed})
    if (list && !std::is_sorted(list->data(), list->data() + list->shape(0)))
      throw std::invalid_argument("graph_chains: edges and closed must be ascending");
  // The search counts each goal once, and finds it by halving.
  std::vector<int32_t> ascending(goals.data(), goals.data() + goals.shape(0));
  std::sort(ascending.begin(), ascending.end());
  ascending.erase(std::unique(ascending.begin(), ascending.end()), ascending.end());
  engram::Passage passage{};
  if (edges)
    passage = {edges->data(), static_cast<int64_t>(edges->shape(0)),
               closed ? closed->data() : nullptr,
               closed ? static_cast<int64_t>(closed->shape(0)) : 0};
  const engram::SearchLimits limits{nullptr,          0, 0, 0, edges ? &passage : nullptr,
                                    ascending.data(), static_cast<int32_t>(ascending.size())};
  std::vector<int32_t> nodes, parents, halves, absent;
  std::vector<double> poses, errors_out;
  {
    nb::gil_scoped_release unlocked;
    std::vector<engram::Reached> reached;
    ENGRAM_CALL(search_chains, graph, static_cast<int32_t>(root), limits, reached, absent);
    for (const engram::Reached &row : reached) {
      nodes.push_back(row.node);
      parents.push_back(row.parent);
      halves.push_back(row.half);
      poses.insert(poses.end(), row.root_from_node, row.root_from_node + 12);
      const engram::ChainError &e = row.error;
      errors_out.insert(errors_out.end(), {e.tau, e.s0, e.s1[0], e.s1[1], e.s1[2], e.s2});
    }
  }
  if (!absent.empty())
    return lacking(std::move(absent));
  const size_t count = nodes.size();
  return nb::make_tuple(nb::make_tuple(engram::to_numpy(std::move(nodes), {count}),
                        engram::to_numpy(std::move(parents), {count}),
                        engram::to_numpy(std::move(halves), {count}),
                        engram::to_numpy(std::move(poses), {count, 12}),
                        engram::to_numpy(std::move(errors_out), {count, 6})), nb::none());
}

// By Cholesky's factor; false for what is no number.
bool is_positive_definite(const double *matrix) {
  double factor[36];
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) {
      double total = matrix[6 * i + j];
      for (int k = 0; k < j; ++k)
        total -= factor[6 * i + k] * factor[6 * j + k];
      if (i == j && !(total > 0 && total < std::numeric_limits<double>::max()))
        return false;
      factor[6 * i + j] = i == j ? std::sqrt(total) : total / factor[7 * j];
    }
  return true;
}

auto pivoted_error(const Input<double, 2> &covariance) {
  if (covariance.shape(0) != 6 || covariance.shape(1) != 6)
    throw std::invalid_argument("pivoted_error: expected a covariance (6, 6)");
  std::vector<double> error(5);
  ENGRAM_CALL(pivoted_error, covariance.data(), error.data());
  return engram::to_numpy(std::move(error), {5});
}

double greatest_sigma(const Input<double, 2> &covariance) {
  if (covariance.shape(0) != 6 || covariance.shape(1) != 6)
    throw std::invalid_argument("greatest_sigma: expected a covariance (6, 6)");
  return std::sqrt(ENGRAM_CALL(greatest_variance, covariance.data()));
}

auto pivoted_errors(const Input<double, 3> &covariances) {
  const size_t count = covariances.shape(0);
  if (covariances.shape(1) != 6 || covariances.shape(2) != 6)
    throw std::invalid_argument("pivoted_errors: expected covariances (E, 6, 6)");
  std::vector<double> errors(5 * count);
  std::vector<uint8_t> definite(count);
  {
    nb::gil_scoped_release unlocked;
    for (size_t i = 0; i < count; ++i) {
      ENGRAM_CALL(pivoted_error, covariances.data() + 36 * i, errors.data() + 5 * i);
      definite[i] = is_positive_definite(covariances.data() + 36 * i);
    }
  }
  return nb::make_tuple(engram::to_numpy(std::move(errors), {count, 5}),
                        engram::to_numpy(std::move(definite), {count}));
}

} // namespace

void bind_graph_search(nb::module_ &module) {
  module.attr("NOT_LOADED") = engram::not_loaded;
  module.def("pivoted_error", &pivoted_error, "covariance"_a,
             "The error model (5,) tau, v, pivot of a covariance (6, 6).");
  module.def("greatest_sigma", &greatest_sigma, "covariance"_a,
             "Standard deviation of the position along its least certain axis, by a covariance "
             "(6, 6) [translation, rotation].");
  module.def("pivoted_errors", &pivoted_errors, "covariances"_a,
             "The error models (E, 5) of covariances (E, 6, 6), and (E,) uint8 whether each is "
             "surely positive definite.");
  nb::class_<Graph>(module, "GraphArrays", "The arrays of an experience graph, checked for shape.")
      .def(nb::init<Input<int32_t, 1>, Input<int32_t, 1>, Input<int32_t, 1>, Input<double, 2>,
                    Input<double, 2>, Input<int32_t, 1>, Input<double, 1>>(),
           "first_half"_a, "next_half"_a, "target"_a, "a_from_b"_a, "errors"_a, "sessions"_a,
           "driven_m"_a);
  nb::class_<engram::CandidateLimits>(module, "CandidateLimits",
                                      "Which nodes are near; see `engram.graph.Search`.")
      .def(nb::init<>())
      .def_rw("radius_m", &engram::CandidateLimits::radius_m)
      .def_rw("margin_m", &engram::CandidateLimits::margin_m)
      .def_rw("view_gate_rad", &engram::CandidateLimits::view_gate_rad)
      .def_rw("slack_sigmas", &engram::CandidateLimits::slack_sigmas)
      .def_rw("slack_m", &engram::CandidateLimits::slack_m)
      .def_rw("vague_m", &engram::CandidateLimits::vague_m)
      .def_rw("detour_m", &engram::CandidateLimits::detour_m)
      .def_rw("own_session", &engram::CandidateLimits::own_session)
      .def_rw("own_driven_m", &engram::CandidateLimits::own_driven_m)
      .def_rw("own_exclusion_m", &engram::CandidateLimits::own_exclusion_m);
  module.def("graph_candidates", &graph_candidates, "graph"_a, "reference"_a,
             "reference_from_live"_a, "live_error"_a, "limits"_a,
             "Columns of a Neighbourhood, the nodes near the live camera, and None; or None and the "
             "nodes (n,) that must be loaded first, whose first half is NOT_LOADED.");
  module.def("graph_chains", &graph_chains, "graph"_a, "root"_a, "goals"_a,
             "edges"_a = nb::none(), "closed"_a = nb::none(),
             "Least uncertain chains from a root: nodes (N,), parent rows (N,), half edges (N,), "
             "root_from_node (N, 12), errors (N, 6: tau, s0, s1, s2). Usable are `edges`, and those "
             "that touch none of the `closed` nodes; without `closed` no other edge, without "
             "`edges` all. With None after it; or None and the nodes (n,) to load first.");
}
