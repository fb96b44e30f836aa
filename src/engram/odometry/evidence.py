"""Speeds measured in the last seconds, each with the evidence for it.

A few landmarks may agree on a wrong motion: the posts of a guard rail are as far apart as the robot
drives between two frames, the light of one's own headlamps moves with it. So a step is judged only
by steps that are as strong as itself, before and after it. A weak run never overrules strong steps,
and what strong steps refute was wrong.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NS_PER_S = 1e9


@dataclass(frozen=True, slots=True)
class Speed:
    """Evidence of one visual step about the speed.

    Attributes:
        stamp_ns: of the frame in which it ends.
        seconds: that it took.
        m_per_s: x, y, z in the camera that it begins in.
        sigma_m: standard deviation of its length.
        inliers: landmarks that agree on it.
        doubted: whether its covariance allows for its being wrong.
    """

    stamp_ns: int
    seconds: float
    m_per_s: list[float]
    sigma_m: float
    inliers: int
    doubted: bool = False

    def off_m(self, other: Speed) -> float:
        """How much further or shorter this step would be at the speed of another one."""
        return math.dist(self.m_per_s, other.m_per_s) * self.seconds

    def within_reach(self, other: Speed, since_s: float, acceleration_m_s2: float) -> bool:
        """Whether an acceleration since then leads from the speed of another step to this one."""
        possible_m = acceleration_m_s2 * since_s * self.seconds
        return self.off_m(other) <= possible_m + 3 * self.sigma_m


class Speeds:
    """Judges steps by those of the last seconds, and says how fast the robot is.

    Args:
        window_s: how long a step counts.
        weak_share: a step with less than this share of the usual inliers is weak.
        steps: so many of the newest make the median speed, and so many in a row may overrule.
        steps_to_know: after so many the speed counts as known.
        greatest_m_s2: greatest acceleration of a robot.
        weak_m_s2: greatest one that a weak step may claim.
    """

    def __init__(
        self,
        window_s: float,
        weak_share: float,
        steps: int,
        steps_to_know: int,
        greatest_m_s2: float,
        weak_m_s2: float,
    ) -> None:
        self._window_ns = round(window_s * _NS_PER_S)
        self._weak_share = weak_share
        self._greatest_m_s2, self._weak_m_s2 = greatest_m_s2, weak_m_s2
        self._steps, self._steps_to_know = steps, steps_to_know
        # Stamp and inliers of all measured steps, and of those that were believed.
        self._seen: deque[tuple[int, int]] = deque()
        self._believed: deque[tuple[int, int]] = deque()
        # Those from which a speed was learnt, and consecutive ones that contradict these.
        self._learnt: deque[Speed] = deque()
        self._against: list[Speed] = []
        # Upper quartile of the inliers: a weak run is usual once it fills most of the window.
        self._usual = 0
        # Fewest inliers of a strong step.
        self.strong_from = 0.0
        # Median of the newest speeds.
        self.m_per_s: NDArray[np.float64] = np.zeros(3)

    @property
    def any(self) -> bool:
        """Whether there is a speed at all."""
        return bool(self._learnt)

    @property
    def known(self) -> bool:
        """Whether it rests on enough steps."""
        return len(self._learnt) >= self._steps_to_know

    def see(self, stamp_ns: int, inliers: int) -> None:
        """A step was measured."""
        for steps in (self._seen, self._believed):
            while len(steps) > self._steps and stamp_ns - steps[0][0] > self._window_ns:
                steps.popleft()
        while len(self._learnt) > self._steps and self._is_old(self._learnt[0], stamp_ns):
            self._learnt.popleft()
        self._seen.append((stamp_ns, inliers))
        counts = sorted(count for _, count in self._seen)
        self._usual = counts[(3 * len(counts)) // 4]
        self.strong_from = self._weak_share * self._usual

    def stronger_than_all(self, inliers: int) -> bool:
        """Whether the evidence for the speed is weak compared with so many inliers."""
        floor = self._floor(inliers)
        return self.any and all(one.inliers < floor for one in self._learnt)

    def possible(self, step: Speed) -> bool:
        """Whether the robot may be as fast as a step says, by what is as strong as it.

        The longer ago that was accepted, the more the speed may have changed; less so by weak
        steps. Steps that agree among themselves, as strong and as many as those that they
        contradict, overrule these.
        """
        floor = self._floor(step.inliers)
        if step.inliers < self.strong_from and not self._likely(step):
            return False
        newest = self._newest(floor)
        if newest is None or step.seconds <= 0:
            return True
        believed = (stamp for stamp, count in reversed(self._believed) if count >= floor)
        since_s = (step.stamp_ns - next(believed, newest.stamp_ns)) / _NS_PER_S
        if step.within_reach(newest, since_s, self._greatest_m_s2):
            return True
        judges = [one for one in self._learnt if one.inliers >= floor]
        return len(judges) < self._steps_to_know or self._overrules(step, judges)

    def believe(self, step: Speed) -> float:
        """Takes a step as true.

        Returns:
            How far earlier undoubted steps that it refutes were wrong in all, m.
        """
        refuted_m = 0.0
        while self._learnt and step.seconds > 0:
            newest = self._learnt[-1]
            since_s = (step.stamp_ns - newest.stamp_ns) / _NS_PER_S
            if step.within_reach(newest, since_s, self._greatest_m_s2):
                break
            overruled = self._against or newest.inliers < self._floor(step.inliers)
            if not overruled:
                break
            refuted_m += 0.0 if newest.doubted else newest.off_m(step)
            self._learnt.pop()
        self._against.clear()
        self._believed.append((step.stamp_ns, step.inliers))
        return refuted_m

    def _likely(self, step: Speed) -> bool:
        """Whether a weak step is one of usual driving, by the newest strong one."""
        strong = self._newest(self.strong_from)
        if strong is None or step.seconds <= 0:
            return True
        since_s = (step.stamp_ns - strong.stamp_ns) / _NS_PER_S
        return step.within_reach(strong, since_s, self._weak_m_s2)

    def learn(self, step: Speed) -> None:
        """Learns the speed from an accepted step."""
        self._learnt.append(step)
        newest = reversed(self._learnt)
        strong = [one.m_per_s for one in newest if one.inliers >= self.strong_from]
        self.m_per_s = _median(strong[: self._steps] or [step.m_per_s])

    def _newest(self, floor: float) -> Speed | None:
        """The newest with so many inliers; None without one."""
        return next((one for one in reversed(self._learnt) if one.inliers >= floor), None)

    def _floor(self, inliers: int) -> float:
        """Fewest inliers of what judges a step of so many: any if it is weak itself."""
        weak = inliers < self.strong_from
        return 0.0 if weak else self._weak_share * max(inliers, self._usual)

    def _overrules(self, step: Speed, judges: Sequence[Speed]) -> bool:
        """Whether steps in a row, with this one, are worth more than those they contradict."""
        if self._against:
            last = self._against[-1]
            since_s = (step.stamp_ns - last.stamp_ns) / _NS_PER_S
            if not step.within_reach(last, since_s, self._greatest_m_s2):
                self._against.clear()
        self._against.append(step)
        floor = self._weak_share * max(one.inliers for one in judges)
        strong = sum(one.inliers >= floor for one in self._against)
        return strong >= max(self._steps, len(judges))

    def _is_old(self, step: Speed, stamp_ns: int) -> bool:
        return stamp_ns - step.stamp_ns > self._window_ns


def _median(rows: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """The median of each column, as `np.median` has it."""
    low, high = (len(rows) - 1) // 2, len(rows) // 2
    columns = (sorted(column) for column in zip(*rows, strict=True))
    return np.array([0.5 * (column[low] + column[high]) for column in columns])
