#include "kernels/path_scores.hpp"

#include "bindings/arrays.hpp"

#include <mutex>
#include <stdexcept>
#include <string>

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Input;

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

auto path_scores(Observed &known, const Input<uint64_t, 2> &bits, int64_t path_count,
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
  const engram::PathEvidence evidence{observed.data(),
                                      reinterpret_cast<const uint8_t *>(outcomes.data()),
                                      static_cast<int64_t>(observed.shape(0)),
                                      reference,
                                      alpha,
                                      gamma};
  std::vector<double> scores(candidates.shape(0));
  {
    nb::gil_scoped_release unlocked;
    const std::scoped_lock held(known.mutex_);
    ENGRAM_CALL(path_scores, paths, known.paths_, candidates.data(), static_cast<int64_t>(scores.size()),
                evidence, scores.data());
  }
  const size_t count = scores.size();
  return engram::to_numpy(std::move(scores), {count});
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
}
