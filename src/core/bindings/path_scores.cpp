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

engram::PathBits paths_of(const Input<uint64_t, 2> &bits, int64_t path_count, int64_t excluded) {
  const engram::PathBits paths{bits.data(), static_cast<int64_t>(bits.shape(0)),
                               static_cast<int64_t>(bits.shape(1)), (path_count + 63) / 64,
                               excluded};
  if (path_count < 0 || paths.words > paths.stride || excluded < -1 || excluded >= path_count)
    throw std::invalid_argument("path bits: " + std::to_string(path_count) +
                                " paths do not fit, or the excluded path " +
                                std::to_string(excluded) + " is none of them");
  return paths;
}

void check_nodes(const engram::PathBits &paths, const Input<int32_t, 1> &nodes) {
  for (size_t i = 0; i < nodes.shape(0); ++i)
    if (nodes.data()[i] < 0 || nodes.data()[i] >= paths.rows)
      throw std::invalid_argument("node " + std::to_string(nodes.data()[i]) +
                                  ": path memory has " + std::to_string(paths.rows) + " rows");
}

auto co_occurrence(const Input<uint64_t, 2> &bits, int64_t path_count, const Input<int32_t, 1> &a,
                   const Input<int32_t, 1> &b, int64_t excluded) {
  const engram::PathBits paths = paths_of(bits, path_count, excluded);
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

struct Evidence {
  engram::PathBits paths;
  engram::PathEvidence seen;
};

Evidence evidence_of(const Input<uint64_t, 2> &bits, int64_t path_count,
                     const Input<int32_t, 1> &candidates, const Input<int32_t, 1> &observed,
                     const Input<bool, 1> &outcomes, int64_t reference, double alpha, double gamma,
                     int64_t excluded) {
  const engram::PathBits paths = paths_of(bits, path_count, excluded);
  check_nodes(paths, candidates);
  check_nodes(paths, observed);
  if (outcomes.shape(0) != observed.shape(0))
    throw std::invalid_argument("path_scores: one outcome per observed node");
  if (reference < -1 || reference >= paths.rows)
    throw std::invalid_argument("path_scores: no node " + std::to_string(reference));
  if (!(alpha > 0 && gamma > 0))
    throw std::invalid_argument("path_scores: alpha and gamma must be positive");
  return {paths,
          {observed.data(), reinterpret_cast<const uint8_t *>(outcomes.data()),
           static_cast<int64_t>(observed.shape(0)), reference, alpha, gamma}};
}

auto path_scores(Observed &known, const Input<uint64_t, 2> &bits, int64_t path_count,
                 const Input<int32_t, 1> &candidates, const Input<int32_t, 1> &observed,
                 const Input<bool, 1> &outcomes, int64_t reference, double alpha, double gamma,
                 int64_t excluded) {
  const Evidence evidence = evidence_of(bits, path_count, candidates, observed, outcomes,
                                        reference, alpha, gamma, excluded);
  const size_t count = candidates.shape(0);
  std::vector<double> scores(count);
  {
    nb::gil_scoped_release unlocked;
    const std::scoped_lock held(known.mutex_);
    ENGRAM_CALL(path_scores, evidence.paths, known.paths_, candidates.data(),
                static_cast<int64_t>(count), evidence.seen, scores.data());
  }
  return engram::to_numpy(std::move(scores), {count});
}

// Γ(path) whole, so that a frame crosses the border once: that took a third of its time.
auto path_order(Observed &known, const Input<uint64_t, 2> &bits, int64_t path_count,
                const Input<int32_t, 1> &candidates, const Input<double, 1> &along_m,
                const Input<double, 1> &across_m, const Input<double, 1> &distance_m,
                const Input<uint64_t, 2> &uuid_words, const Input<double, 2> &basin_rates,
                double bin_m, double level, const Input<int32_t, 1> &observed,
                const Input<bool, 1> &outcomes, int64_t reference, double alpha, double gamma,
                int64_t excluded) {
  const Evidence evidence = evidence_of(bits, path_count, candidates, observed, outcomes,
                                        reference, alpha, gamma, excluded);
  const size_t count = candidates.shape(0);
  if (along_m.shape(0) != count || across_m.shape(0) != count || distance_m.shape(0) != count)
    throw std::invalid_argument("path_order: one offset and one distance per candidate");
  if (basin_rates.shape(0) != 2 || basin_rates.shape(1) == 0 || !(bin_m > 0))
    throw std::invalid_argument("path_order: basin_rates must have shape (2, B)");
  if (uuid_words.shape(1) != 2)
    throw std::invalid_argument("path_order: uuid_words must have shape (N, 2)");
  for (size_t i = 0; i < count; ++i)
    if (static_cast<size_t>(candidates.data()[i]) >= uuid_words.shape(0))
      throw std::invalid_argument("path_order: no UUID of node " +
                                  std::to_string(candidates.data()[i]));
  const auto rows = static_cast<int64_t>(count);
  std::vector<double> rates(count), beyond(count), scores(count, 0), of_near;
  std::vector<int32_t> near;
  std::vector<int64_t> order(count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(success_rates, basin_rates.data(), static_cast<int64_t>(basin_rates.shape(1)),
                bin_m, along_m.data(), across_m.data(), rows, rates.data());
    for (size_t i = 0; i < count; ++i) {
      beyond[i] = rates[i] >= level ? 0 : 1;
      if (rates[i] >= level)
        near.push_back(candidates.data()[i]);
    }
    of_near.resize(near.size());
    const std::scoped_lock held(known.mutex_);
    ENGRAM_CALL(path_scores, evidence.paths, known.paths_, near.data(),
                static_cast<int64_t>(near.size()), evidence.seen, of_near.data());
    for (size_t i = 0, next = 0; i < count; ++i)
      if (beyond[i] == 0)
        scores[i] = -std::nearbyint(of_near[next++] * kTieScale);
    std::vector<const double *> keys{scores.data(), distance_m.data()};
    if (near.size() < count)
      keys.insert(keys.begin(), beyond.data());
    ENGRAM_CALL(order_rows, keys, candidates.data(), rows, uuid_words.data(), order.data());
  }
  return engram::to_numpy(std::move(order), {count});
}

} // namespace

void bind_path_scores(nb::module_ &module) {
  module.def("co_occurrence", &co_occurrence, "bits"_a, "path_count"_a, "a"_a, "b"_a,
             "excluded"_a = -1,
             "Number of paths (A, B) int32 that hold both nodes a (A,) and b (B,).");
  nb::class_<Observed>(module, "ObservedPaths",
                       "What is known of the nodes observed lately, kept from frame to frame.")
      .def(nb::init<>())
      .def("add", &Observed::add, "node"_a, "path"_a, "A node has come onto a path.");
  module.def("path_scores", &path_scores, "known"_a, "bits"_a, "path_count"_a, "candidates"_a, "observed"_a,
             "outcomes"_a, "reference"_a, "alpha"_a, "gamma"_a, "excluded"_a = -1,
             "Log of the unnormalised posterior (Y,) float64 of each candidate, [L15 (1)-(5)].");
  module.def("path_order", &path_order, "known"_a, "bits"_a, "path_count"_a, "candidates"_a,
             "along_m"_a, "across_m"_a, "distance_m"_a, "uuid_words"_a, "basin_rates"_a, "bin_m"_a,
             "level"_a, "observed"_a, "outcomes"_a, "reference"_a, "alpha"_a, "gamma"_a,
             "excluded"_a = -1,
             "Rows (Y,) int64: candidates whose g is at least `level` by that posterior, then the "
             "others; ties by distance, then by UUID (N, 2).");
}
