// The pose between two frames of possibly different cameras, from matched landmarks.
#pragma once

#include "dispatch.hpp"
#include "kernels/types.hpp"

ENGRAM_DECLARE_KERNELS(
    // The pose that most of the pairs agree on (MSAC), refined robustly, with covariance; not found
    // where fewer than `min_consensus` agree. Equal arguments give equal bits.
    PoseEstimate estimate_pose(const FrameView &reference, const FrameView &live,
                               const std::vector<RowPair> &pairs, const MatchSettings &settings,
                               uint64_t seed, const RigidTransform *first_guess);

    // Matches two frames and estimates their pose; with a prediction the search is guided by it.
    // A consensus guides a second pass that gathers what the first one missed. Without a prediction
    // a part of the landmarks is looked at first; where it agrees clearly, it guides at once.
    PoseEstimate attempt(const FrameView &reference, const FrameView &live,
                         const MatchSettings &settings, uint64_t seed,
                         const Prediction *prediction);)
