"""Pairs the images of two cameras by stamp, even where the clock of one was set."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from statistics import median_low
from typing import TypeVar

from engram.sequences.clocks import Timed

L = TypeVar("L")
R = TypeVar("R")

# Intervals of the left images whose lower median is the usual one.
_NEWEST_INTERVALS = 15


def paired(
    left: Iterator[Timed[L]], right: Iterator[Timed[R]], tolerance_ns: int
) -> Iterator[tuple[Timed[L] | None, Timed[R] | None]]:
    """The items of both sides by rising time, those of one instant together.

    A pair's stamps agree within the tolerance. Where the clock of one side was set, its stamps
    never agree again: from there on times count, which then differ by what the first two after the
    step do. These are closer than half an interval.

    Args:
        left, right: the items of each side, by rising time.
        tolerance_ns: largest difference of stamps within a pair, ns.
    """
    pairing = _Pairing(tolerance_ns)
    waiting = next(right, None)
    for item in left:
        pairing.next_left(item)
        while waiting is not None and pairing.is_before(waiting, item):
            yield None, waiting
            waiting = next(right, None)
        found = waiting
        if found is None or not pairing.matches(item, found):
            yield item, None
            continue
        waiting = next(right, None)
        while waiting is not None and pairing.is_nearer(item, waiting, found):
            yield None, found
            found, waiting = waiting, next(right, None)
        pairing.learn(item, found)
        yield item, found
    while waiting is not None:
        yield None, waiting
        waiting = next(right, None)


class _Pairing:
    def __init__(self, tolerance_ns: int) -> None:
        self._tolerance_ns = tolerance_ns
        # What the right's times lack to the left's: steps are measured on each side by itself.
        self._lag_ns = 0
        # Whether a clock was set since the last pair, so that this is not known.
        self._loose = False
        # Whether there was a pair, so that times of both sides can be compared.
        self._known = False
        self._last_ns: int | None = None
        self._intervals_ns: deque[int] = deque(maxlen=_NEWEST_INTERVALS)

    def next_left(self, item: Timed[L]) -> None:
        """Counts the next left item."""
        self._loose = self._loose or item.step is not None
        if self._last_ns is not None:
            self._intervals_ns.append(item.time_ns - self._last_ns)
        self._last_ns = item.time_ns

    def is_before(self, right: Timed[R], left: Timed[L]) -> bool:
        """Whether a right item is too early for this left one, and so for all that come."""
        self._loose = self._loose or right.step is not None
        if abs(right.stamp_ns - left.stamp_ns) <= self._tolerance_ns:
            return False
        if not self._known and right.stamp_ns > left.stamp_ns:
            return False
        return left.time_ns - right.time_ns - self._lag_ns > self._slack_ns

    def matches(self, left: Timed[L], right: Timed[R]) -> bool:
        """Whether the two are of one instant."""
        if abs(left.stamp_ns - right.stamp_ns) <= self._tolerance_ns:
            return True
        set_apart = left.time_ns - left.stamp_ns != right.time_ns - right.stamp_ns
        off_ns = abs(left.time_ns - right.time_ns - self._lag_ns)
        return (set_apart or self._loose) and off_ns <= self._slack_ns

    def is_nearer(self, left: Timed[L], right: Timed[R], found: Timed[R]) -> bool:
        """Whether a right item fits better than the one found."""
        off_ns, other_ns = (abs(left.stamp_ns - one.stamp_ns) for one in (right, found))
        return off_ns <= self._tolerance_ns and off_ns < other_ns

    def learn(self, left: Timed[L], right: Timed[R]) -> None:
        """Takes in a pair."""
        if self._loose or left.stamp_ns != left.time_ns or right.stamp_ns != right.time_ns:
            self._lag_ns = left.time_ns - right.time_ns
        self._loose, self._known = False, True

    @property
    def _slack_ns(self) -> int:
        """How far times of a pair may be apart, ns: nearly half an interval after a step."""
        if not self._loose or not self._intervals_ns:
            return self._tolerance_ns
        return max(self._tolerance_ns, median_low(self._intervals_ns) // 2 - 1)
