"""Live frames matched with those of a map as if the live camera were calibrated otherwise.

A wrong focal length or baseline bends the scene that a robot measures. Fewer landmarks then fit the
map, and where they do, the position is off: of a scene 15 m away by 1.5 m for a focal length that
is wrong by a tenth. As they fit best by the right calibration, the map shows what that is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry import StereoCamera

# Factors by which focal length or baseline may be too large: 0.75 to 1.33, in steps of 5 %.
FACTORS: NDArray[np.float64] = np.exp(np.linspace(-1, 1, 13) * np.log(4 / 3))
AS_IT_IS = len(FACTORS) // 2
# So many frames are matched again, each at least so many after the one before.
MOST, APART = 16, 8
# Inliers tell something if there are so many a frame, and stand out of their median by so many of
# its standard deviations, as chance would have it.
_LEAST, _STANDS_OUT = 5, 6.0
# Another calibration fits better that has so many times the inliers, and so many standard
# deviations more.
_GAIN, _MORE = 1.03, 1.0


@dataclass(slots=True)
class Rematched:
    """Inliers of the frames that were matched again.

    Attributes:
        frames: how many.
        focal, baseline: (13,) int64: sums of their inliers if that is too large by `FACTORS`.
    """

    frames: int = 0
    focal: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(FACTORS), np.int64))
    baseline: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(FACTORS), np.int64))

    def add(self, reference: Frame, live: Frame, matcher: MatcherConfig) -> None:
        """Matches one more live frame with a frame of the map that shows the same."""

        def inliers(camera: StereoCamera) -> int:
            seen = replace(live, camera=camera)
            return match_frames(reference, seen, matcher, self.frames).inliers

        camera = live.camera
        self.focal += [inliers(_refocused(camera, by)) for by in FACTORS.tolist()]
        self.baseline += [inliers(_rebased(camera, by)) for by in FACTORS.tolist()]
        self.frames += 1

    @property
    def focal_factor(self) -> float | None:
        """Factor by which the focal length is too long; None if undetermined."""
        return self._factor(self.focal, self.baseline)

    @property
    def baseline_factor(self) -> float | None:
        """The same of the baseline."""
        return self._factor(self.baseline, self.focal)

    def _factor(self, inliers: NDArray[np.int64], other: NDArray[np.int64]) -> float | None:
        """Where the inliers are most; 1 where the calibration, or the other fault, fits better."""
        most, usual = int(inliers.max()), int(inliers[AS_IT_IS])
        chance = float(np.median([inliers, other]))
        least = max(_LEAST * self.frames, chance + _STANDS_OUT * chance**0.5)
        if self.frames == 0 or max(most, int(other.max())) < least:
            return None
        better = most >= _GAIN * usual and most >= usual + _MORE * usual**0.5
        if not better or most < other.max():
            return 1.0
        return float(np.exp(_peak(np.log(FACTORS), inliers)))


def _refocused(camera: StereoCamera, by: float) -> StereoCamera:
    return replace(camera, fx=camera.fx / by, fy=camera.fy / by)


def _rebased(camera: StereoCamera, by: float) -> StereoCamera:
    return replace(camera, baseline_m=camera.baseline_m / by)


def _peak(at: NDArray[np.float64], heights: NDArray[np.int64]) -> float:
    """Peak of a parabola through the highest of evenly spaced heights and its neighbours."""
    top = int(heights.argmax())
    if not 0 < top < len(at) - 1:
        return float(at[top])
    before, highest, after = (float(one) for one in heights[top - 1 : top + 2])
    bend = before - 2 * highest + after
    return float(at[top] + (at[1] - at[0]) * (0.5 * (before - after) / bend if bend else 0.0))
