#include "kernels/ordering.hpp"
#include "kernels/path_scores.hpp"

#include "bindings/arrays.hpp"

#include <cmath>
#include <mutex>
#include <stdexcept>
#include <string>

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Input;

// Posteriors that are equal on paper tie, though their logarithms were added up from other numbers:
// 2^-30 is far more than rounding comes to, and far less than a path makes of a difference.
constexpr double kTieScale = 0x1p30;

// Which paths each node is on; holds on to its bits.
struct Paths {
  Input<uint64_t, 2> bits;
  int64_t count;

  Paths(Input<uint64_t, 2> bits, int64_t count) : bits(bits), count(count) {
    if (count < 0 || (count + 63) / 64 > static_cast<int64_t>(bits.shape(1)))
      throw std::invalid_argument("path bits: " + std::to_string(count) + " paths do not fit");
  }

  engram::PathBits view(int64_t excluded) const {
    if (excluded < -1 || excluded >= count)
      throw std::invalid_argument("path bits: the excluded path " + std::to_string(excluded) +
                                  " is none of " + std::to_string(count));
    return {bits.data(), static_cast<int64_t>(bits.shape(0)), static_cast<int64_t>(bits.shape(1)),
            (count + 63) / 64, excluded};
  }
};

void check_nodes(const engram::PathBits &paths, const Input<int32_t, 1> &nodes) {
  for (size_t i = 0; i < nodes.shape(0); ++i)
    if (nodes.data()[i] < 0 || nodes.data()[i] >= paths.rows)
      throw std::invalid_argument("node " + std::to_string(nodes.data()[i]) +
                                  ": path memory has " + std::to_string(paths.rows) + " rows");
}

auto co_occurrence(const Paths &all, const Input<int32_t, 1> &a, const Input<int32_t, 1> &b,
                   int64_t excluded) {
  const engram::PathBits paths = all.view(excluded);
  check_nodes(paths, a);
  check_nodes(paths, b);
  const size_t a_count = a.shape(0), b_count = b.shape(0);
  std::vector<int32_t> counts(a_count * b_count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(co_occurrence, paths, a.data(), static_cast<int64_t>(a_count), b.data(),
                static_cast<int64_t>(b_count), counts.data());
  }
  return engram::to_numpy(std::move(counts), {a_count, b_count});
}

// `ObservedPaths` behind a lock: robots on several threads may share a path memory.
class Observed {
public:
  void add(int32_t node, int64_t path) {
    if (node < 0 || path < 0)
      throw std::invalid_argument("observed paths: a node and a path are not negative");
    const std::scoped_lock held(mutex_);
    ENGRAM_CALL(note_on_path, paths_, node, path);
  }

  std::mutex mutex_;
  engram::ObservedPaths paths_;
};

// What the posterior is given: W, z and k of [L15 §V]; holds on to its arrays.
struct Evidence {
  Input<int32_t, 1> observed;
  Input<bool, 1> outcomes;
  int64_t reference, excluded;
  double alpha, gamma;

  Evidence(Input<int32_t, 1> observed, Input<bool, 1> outcomes, int64_t reference,
           int64_t excluded, double alpha, double gamma)
      : observed(observed), outcomes(outcomes), reference(reference), excluded(excluded),
        alpha(alpha), gamma(gamma) {
    if (outcomes.shape(0) != observed.shape(0))
      throw std::invalid_argument("path evidence: one outcome per observed node");
    if (!(alpha > 0 && gamma > 0))
      throw std::invalid_argument("path evidence: alpha and gamma must be positive");
  }

  engram::PathEvidence view(const engram::PathBits &paths) const {
    check_nodes(paths, observed);
    if (reference < -1 || reference >= paths.rows)
      throw std::invalid_argument("path evidence: no node " + std::to_string(reference));
    return {observed.data(), reinterpret_cast<const uint8_t *>(outcomes.data()),
            static_cast<int64_t>(observed.shape(0)), reference, alpha, gamma};
  }
};

auto path_scores(Observed &known, const Paths &all, const Input<int32_t, 1> &candidates,
                 const Evidence &evidence) {
  const engram::PathBits paths = all.view(evidence.excluded);
  check_nodes(paths, candidates);
  const engram::PathEvidence seen = evidence.view(paths);
  const size_t count = candidates.shape(0);
  std::vector<double> scores(count);
  {
    nb::gil_scoped_release unlocked;
    const std::scoped_lock held(known.mutex_);
    ENGRAM_CALL(path_scores, paths, known.paths_, candidates.data(), static_cast<int64_t>(count),
                seen, scores.data());
  }
  return engram::to_numpy(std::move(scores), {count});
}

// The candidates as Γ(path-near) sees them; holds on to its arrays.
struct PathCandidates {
  Input<int32_t, 1> nodes;
  Input<double, 1> along_m, across_m, distance_m;
  Input<uint64_t, 2> uuid_words;

  PathCandidates(Input<int32_t, 1> nodes, Input<double, 1> along_m, Input<double, 1> across_m,
                 Input<double, 1> distance_m, Input<uint64_t, 2> uuid_words)
      : nodes(nodes), along_m(along_m), across_m(across_m), distance_m(distance_m),
        uuid_words(uuid_words) {
    const size_t count = nodes.shape(0);
    if (along_m.shape(0) != count || across_m.shape(0) != count || distance_m.shape(0) != count)
      throw std::invalid_argument("path candidates: one offset and one distance per candidate");
    if (uuid_words.shape(0) != count || uuid_words.shape(1) != 2)
      throw std::invalid_argument("path candidates: uuid_words must have shape (Y, 2)");
  }
};

// Γ(path-near) whole, so that a frame crosses the border once: that took a third of its time.
auto path_order(Observed &known, const Paths &all, const PathCandidates &candidates,
                const Evidence &evidence, const Input<double, 2> &basin_rates, double bin_m,
                double level) {
  const engram::PathBits paths = all.view(evidence.excluded);
  check_nodes(paths, candidates.nodes);
  const engram::PathEvidence seen = evidence.view(paths);
  const size_t count = candidates.nodes.shape(0);
  const int32_t *nodes = candidates.nodes.data();
  if (basin_rates.shape(0) != 2 || basin_rates.shape(1) == 0 || !(bin_m > 0))
    throw std::invalid_argument("path_order: basin_rates must have shape (2, B)");
  const auto rows = static_cast<int64_t>(count);
  std::vector<double> rates(count), beyond(count), scores(count, 0), of_near;
  std::vector<int32_t> near;
  std::vector<int64_t> order(count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(success_rates, basin_rates.data(), static_cast<int64_t>(basin_rates.shape(1)),
                bin_m, candidates.along_m.data(), candidates.across_m.data(), rows, rates.data());
    for (size_t i = 0; i < count; ++i) {
      beyond[i] = rates[i] >= level ? 0 : 1;
      if (rates[i] >= level)
        near.push_back(nodes[i]);
    }
    of_near.resize(near.size());
    const std::scoped_lock held(known.mutex_);
    ENGRAM_CALL(path_scores, paths, known.paths_, near.data(), static_cast<int64_t>(near.size()),
                seen, of_near.data());
    for (size_t i = 0, next = 0; i < count; ++i)
      if (beyond[i] == 0)
        scores[i] = -std::nearbyint(of_near[next++] * kTieScale);
    std::vector<const double *> keys{scores.data(), candidates.distance_m.data()};
    if (near.size() < count)
      keys.insert(keys.begin(), beyond.data());
    ENGRAM_CALL(order_rows, keys, rows, candidates.uuid_words.data(), order.data());
  }
  return engram::to_numpy(std::move(order), {count});
}

} // namespace

void bind_path_scores(nb::module_ &module) {
  nb::class_<Paths>(module, "PathBits", "Which of `count` paths each node is on, (N, words).")
      .def(nb::init<Input<uint64_t, 2>, int64_t>(), "bits"_a, "count"_a);
  nb::class_<Evidence>(module, "PathEvidence",
                       "Nodes observed lately and their outcomes, (W,) each; the reference node "
                       "and the path that does not count, -1 for none.")
      .def(nb::init<Input<int32_t, 1>, Input<bool, 1>, int64_t, int64_t, double, double>(),
           "observed"_a, "outcomes"_a, "reference"_a, "excluded"_a, "alpha"_a, "gamma"_a);
  nb::class_<PathCandidates>(module, "PathCandidates", "Candidates (Y,) and their UUIDs (Y, 2).")
      .def(nb::init<Input<int32_t, 1>, Input<double, 1>, Input<double, 1>, Input<double, 1>,
                    Input<uint64_t, 2>>(),
           "nodes"_a, "along_m"_a, "across_m"_a, "distance_m"_a, "uuid_words"_a);
  nb::class_<Observed>(module, "ObservedPaths",
                       "What is known of the nodes observed lately, kept from frame to frame.")
      .def(nb::init<>())
      .def("add", &Observed::add, "node"_a, "path"_a, "A node has come onto a path.");
  module.def("co_occurrence", &co_occurrence, "paths"_a, "a"_a, "b"_a, "excluded"_a = -1,
             "Number of paths (A, B) int32 that hold both nodes a (A,) and b (B,).");
  module.def("path_scores", &path_scores, "known"_a, "paths"_a, "candidates"_a, "evidence"_a,
             "Log of the unnormalised posterior (Y,) float64 of each candidate, [L15 (1)-(5)].");
  module.def("path_order", &path_order, "known"_a, "paths"_a, "candidates"_a, "evidence"_a,
             "basin_rates"_a, "bin_m"_a, "level"_a,
             "Rows (Y,) int64: candidates whose g is at least `level` by that posterior, then the "
             "others; ties by distance, then by UUID.");
}
