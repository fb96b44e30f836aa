// The ranking of [L15 §V] over path memory: co-occurrence counts by popcount, the likelihood as a
// product in double.
#pragma once

#include <cstdint>
#include <vector>

#include "dispatch.hpp"

namespace engram {

// Which paths each node is on: row n of `bits` holds `stride` words, of which `words` are in use.
struct PathBits {
  const uint64_t *bits;
  int64_t rows, stride, words;
  int64_t excluded; // number of a path that does not count, or -1
};

// Logarithms of n + offset for whole n, each worked out once; 0 where it has not been yet.
struct KnownLogarithms {
  double offset = 0;
  std::vector<double> of;
};

// Which of the nodes observed lately are on each path, kept from frame to frame: few of them change.
struct ObservedPaths {
  std::vector<uint64_t> storage; // one row of 512 nodes per path and vector, and an empty one
  int64_t vectors = 0, paths = 0;
  std::vector<int32_t> node_of; // by slot, which is a node's bit in the rows; -1 where it is free
  std::vector<int32_t> slot_of; // by node; -1 where it has none
  KnownLogarithms of_success, of_total, of_failure, of_prior;
};

struct PathEvidence {
  const int32_t *observed; // W, each node once
  const uint8_t *outcomes; // (W) z: 1 where the attempt succeeded
  int64_t observed_count;
  int64_t reference; // node k, or -1
  double alpha, gamma;
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // counts[i * b_count + j] = number of paths that hold both a[i] and b[j].
    void co_occurrence(const PathBits &paths, const int32_t *a, int64_t a_count, const int32_t *b,
                       int64_t b_count, int32_t *counts);

    // scores[i] = log of the unnormalised posterior of candidate i [L15 (1)-(5)].
    // Throws std::invalid_argument where a node is observed twice.
    void path_scores(const PathBits &paths, ObservedPaths &known, const int32_t *candidates,
                     int64_t count, const PathEvidence &evidence, double *scores);

    // Tells `known` that a node has come onto a path.
    void note_on_path(ObservedPaths &known, int32_t node, int64_t path);)
