// Which landmarks of two frames look alike: over the whole frames, or near a predicted place.
#pragma once

#include "dispatch.hpp"
#include "kernels/types.hpp"

namespace engram {

// Looks at the pairs of the first part of the reference's landmarks, and says whether they are
// enough, so that the others need not be compared.
struct Glance {
  void *state;
  bool (*suffices)(void *state, const std::vector<RowPair> &pairs);
};

} // namespace engram

ENGRAM_DECLARE_KERNELS(
    // Pairs that are each other's nearest descriptor, distinctly so, among landmarks whose patches
    // could be of one size in the world (method §2.6). With a glance, every `glance_share`-th landmark
    // of the reference is compared first; returns whether these sufficed.
    bool match_all(const FrameView &reference, const FrameView &live, const MatchSettings &settings,
                   std::vector<RowPair> &pairs, const Glance *glance);

    // The same among live landmarks near where the prediction projects the reference's. How near
    // follows from the covariance of the prediction and the landmark's own.
    void match_near(const FrameView &reference, const FrameView &live,
                    const Prediction &prediction, const MatchSettings &settings,
                    std::vector<RowPair> &pairs);)
