"""One rule for the stamps of a stream: of images, motion or satellite fixes, from files and live.

A stream's *time* rises whatever its clock does. As long as stamps rise, time is the stamp.

- **Faulty stamps** (zero, early, far ahead, repeated) go, and only they: the stamps after them go
  on from those before.
- **A clock that was set** shows in three stamps that follow each other, but not those before. Then
  a new stretch begins. Set forwards, its times are its stamps: this cannot be distinguished from a
  pause, unless whoever received the messages noticed no pause. Set back, its times count on from
  those before, and the difference is noted as a `ClockStep`.

A reader of files waits for the stamps that decide, and loses none at a step. A live robot cannot
wait, and loses two.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import pairwise
from math import inf
from statistics import median_low
from typing import Generic, TypeVar

from engram.counts import counted

T = TypeVar("T")

# Stamps that follow each other and make a clock: one may be anything, two may be one fault twice.
_CONFIRMED = 3
# Rising stamps that make one without any usual interval, and intervals from which that is known.
_IRREGULAR, _KNOWN_FROM = 5, 3
# Stamps that may wait for a decision.
_MOST_WAITING = 12
# Intervals whose lower median is the usual one.
_NEWEST_INTERVALS = 15
# An interval that is longer, in usual ones, may be a fault: where it can, the rule waits for more.
_USUAL_RATIO = 2.5
# What is ahead by more than both, in usual intervals and ns, is no lost frames until confirmed.
_FAR_RATIO, _FAR_NS = 10, 1_000_000_000
# One or two stamps at either end of a drive are wrong if they are off by more than both.
_LONE_NS = 10_000_000_000
# Of the first two items an interval is not known yet: cameras take ten images a second.
_UNKNOWN_NS = 100_000_000
# A receiver noticed no pause if its own interval was shorter, in its usual ones.
_RECEIVED_RATIO = 3


class StampFault(StrEnum):
    """Why a stamp is left out."""

    REPEATED = "repeats the stamp of the one before"
    EARLY = "is stamped before the one before"
    AHEAD = "is stamped far after its neighbours"


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A clock that was set, between two items of a stream.

    Attributes:
        number: of the first item after it, from 0.
        by_ns: what was added to the clock, about, ns; or, set forwards, perhaps a pause.
        shift_ns: time minus stamp from there on, ns.
    """

    number: int
    by_ns: int
    shift_ns: int
    time_ns: int

    def text(self) -> str:
        """For people, in one line."""
        how = f"the clock went {'back' if self.by_ns < 0 else 'forwards'} by "
        counted_on = f"; times are stamps {self.shift_ns / 1e9:+.3f} s" if self.shift_ns else ""
        return f"{how}{abs(self.by_ns) / 1e9:.3f} s at number {self.number}{counted_on}"


@dataclass(frozen=True, slots=True)
class StampReport:
    """What happened to the stamps of a stream.

    Attributes:
        repeated, early, ahead: those left out, by their fault.
        example: the first of them, for people; "" without one.
    """

    count: int = 0
    repeated: int = 0
    early: int = 0
    ahead: int = 0
    example: str = ""
    steps: tuple[ClockStep, ...] = ()

    @property
    def left_out(self) -> int:
        """Stamps left out."""
        return self.repeated + self.early + self.ahead

    @property
    def faulty(self) -> int:
        """Stamps left out that are wrong, not only repeated: what was measured then is lost."""
        return self.early + self.ahead

    @property
    def faulty_share(self) -> float:
        """Share of the stamps that are faulty."""
        return self.faulty / self.count if self.count else 0.0

    def texts(self, what: str) -> list[str]:
        """For people, a line for each fact; none of a sound clock.

        Args:
            what: what carries the stamps, such as "left image".
        """
        lines = []
        if self.left_out:
            kinds = {"repeated": self.repeated, "early": self.early, "ahead": self.ahead}
            facts = ", ".join(f"{number} {kind}" for kind, number in kinds.items() if number)
            lines.append(
                f"{self.left_out} of {counted(self.count, what)} left out for the stamp ({facts}), "
                f"such as {self.example}"
            )
        return lines + [f"{what}s: {step.text()}" for step in self.steps]


def joined(*reports: StampReport) -> StampReport:
    """The report of streams that belong together, such as the two sides of a stereo camera.

    A fault of both cameras is one fault: of each count the larger holds. Steps are those of the
    first stream that has any.
    """
    return StampReport(
        reports[0].count,
        max(report.repeated for report in reports),
        max(report.early for report in reports),
        max(report.ahead for report in reports),
        next((report.example for report in reports if report.example), ""),
        next((report.steps for report in reports if report.steps), ()),
    )


@dataclass(frozen=True, slots=True)
class Timed(Generic[T]):
    """An item of a stream with its time.

    Attributes:
        number: its place in the stream, from 0.
        step: where the clock was set just before it; None elsewhere.
    """

    item: T
    number: int
    stamp_ns: int
    time_ns: int
    step: ClockStep | None = None


@dataclass(frozen=True, slots=True)
class _Stamp:
    number: int
    stamp_ns: int
    received_ns: int | None


@dataclass(frozen=True, slots=True)
class Placed:
    """A stamp that has its place.

    Attributes:
        number: its place in the stream, from 0.
        step: where the clock was set just before it; None elsewhere.
    """

    number: int
    stamp_ns: int
    time_ns: int
    step: ClockStep | None = None


class SteadyClock:
    """The rule as a state: stamps in, times out.

    Args:
        waits: whether the caller waits for stamps that come later, as a reader of files does.
        left_out: called with the number and the fault of each stamp that is left out.
    """

    def __init__(
        self, *, waits: bool, left_out: Callable[[int, StampFault], None] = lambda *_: None
    ) -> None:
        self.steps: list[ClockStep] = []
        self._waits = waits
        self._left_out = left_out
        self._count = 0
        self._counts = dict.fromkeys(StampFault, 0)
        self._example = ""
        self._last: _Stamp | None = None
        self._time_ns = 0
        self._shift_ns = 0
        # What has no place yet, in the order in which it came.
        self._waiting: list[_Stamp] = []
        self._intervals_ns: deque[float] = deque(maxlen=_NEWEST_INTERVALS)
        self._received_ns: deque[float] = deque(maxlen=_NEWEST_INTERVALS)
        # The stamp before the newest one, if the two are far apart: the newest may be a fault.
        self._before_jump: _Stamp | None = None

    @property
    def time_ns(self) -> int | None:
        """The newest time; None before the first."""
        return None if self._last is None else self._time_ns

    @property
    def shift_ns(self) -> int:
        """Time minus stamp, ns, since the newest step."""
        return self._shift_ns

    @property
    def newest_waits(self) -> bool:
        """Whether the newest stamp has no place; live, its item is left out."""
        return bool(self._waiting)

    @property
    def expected_ns(self) -> int:
        """About the time of the newest stamp, with a place or without, ns; 0 before the first."""
        if self._last is None:
            return 0
        return self._time_ns + round((self._count - 1 - self._last.number) * self._median_ns)

    def elapsed_ns(self, stamp_ns: int) -> int:
        """About the time from the newest stamp to the next one, which is not taken yet, ns."""
        newest = self._waiting[-1] if self._waiting else self._last
        if newest is None:
            return 0
        upcoming = _Stamp(newest.number + 1, stamp_ns, None)
        goes_on = _rises(newest, upcoming) and not self._is_far(newest, upcoming)
        return stamp_ns - newest.stamp_ns if goes_on else round(self._median_ns)

    @property
    def report(self) -> StampReport:
        """What happened to the stamps so far."""
        repeated, early, ahead = (self._counts[fault] for fault in StampFault)
        return StampReport(self._count, repeated, early, ahead, self._example, tuple(self.steps))

    def take(
        self, stamp_ns: int, received_ns: int | None = None, *, trusted: bool = False
    ) -> list[Placed]:
        """Takes the next stamp.

        Args:
            received_ns: when a recorder received it, by a clock of its own; None if unknown.
            trusted: whether a reader has looked after it: it is right if it rises.

        Returns:
            The stamps that have their place now, this one the last of them; none if it has none.
            Stamps that came before and are not among them are left out.
        """
        stamp = _Stamp(self._count, stamp_ns, received_ns)
        self._count += 1
        last = self._last
        rises = last is None or _rises(last, stamp)
        chain = [stamp] if trusted and rises else self._going_on(stamp)
        if chain is None:
            self._wait(stamp)
            return []
        if last is not None and (not _rises(last, chain[0]) or self._is_far(last, chain[0])):
            return self._stepped(chain)
        return self._placed(chain)

    def end(self) -> list[Placed]:
        """Decides what still waits, as nothing comes any more; returns what has its place."""
        last, waiting = self._last, self._waiting
        if not self._waits or not waiting:
            return []
        if last is None:
            chains = [_longest(waiting[: n + 1], _rises) for n in range(len(waiting))]
            return self._placed(max(chains, key=len))
        near = partial(_follows, usual_ns=self._usual_ns(inf), far_ns=_LONE_NS)
        if all(near(a, b) for a, b in pairwise([last, *waiting])):
            return self._placed(waiting[:])
        return self._placed([stamp for stamp in waiting if near(last, stamp)][:1])

    def time_of(self, stamp_ns: int) -> int:
        """The time of a stamp: in the newest stretch that has it, else as after the newest step."""
        until_ns = self._time_ns + 1
        for step in reversed(self.steps):
            if step.time_ns <= stamp_ns + step.shift_ns < until_ns:
                return stamp_ns + step.shift_ns
            until_ns = step.time_ns
        return stamp_ns if stamp_ns < until_ns else stamp_ns + self._shift_ns

    def stamp_of(self, time_ns: int) -> int:
        """The stamp that has this time."""
        at = bisect_right(self.steps, time_ns, key=lambda step: step.time_ns)
        return time_ns - (self.steps[at - 1].shift_ns if at else 0)

    @property
    def _median_ns(self) -> float:
        return median_low(self._intervals_ns) if self._intervals_ns else 0.0

    def _usual_ns(self, unknown: float) -> float:
        known = len(self._intervals_ns) >= (1 if self._waits else _KNOWN_FROM)
        return self._median_ns if known else unknown

    def _is_far(self, a: _Stamp, b: _Stamp) -> bool:
        """Whether b is ahead of a by more than lost frames usually explain."""
        return _is_far(a, b, self._usual_ns(inf))

    def _going_on(self, stamp: _Stamp) -> list[_Stamp] | None:
        """The stamps whose places are settled; None while they are not."""
        last, known = self._last, [*self._waiting, stamp]
        if last is None:
            return self._beginning(known) if self._waits else [stamp]
        usual_ns = self._usual_ns(inf)
        follows = partial(_follows, usual_ns=usual_ns)
        rising = all(_rises(a, b) for a, b in pairwise([last, *known]))
        since = _longest([last, *known], follows, first=last)[1:]
        since = known if since and rising else since
        chain = _longest(known, follows)
        if since and (len(chain) < max(_CONFIRMED, len(since) + 1) or not self._waits):
            doubtful = stamp.stamp_ns - last.stamp_ns > _USUAL_RATIO * usual_ns
            return None if self._waits and doubtful and not self._waiting else since
        if not since and self._returns(stamp):
            return [stamp]
        if len(chain) >= _CONFIRMED:
            return known if rising else chain
        if (rising and len(known) >= _IRREGULAR) or len(known) >= _MOST_WAITING:
            chain = _longest(known, _rises)
            return chain if len(chain) >= _CONFIRMED else None
        return None

    def _beginning(self, known: list[_Stamp]) -> list[_Stamp] | None:
        """The first stamps, once three follow each other at about one interval."""
        stamp = known[-1]
        for before in reversed(known[:-1]):
            usual_ns = _per_item_ns(before, stamp)
            alike = partial(_alike, usual_ns=usual_ns)
            if usual_ns > 0 and len(chain := _longest(known, alike)) >= _CONFIRMED:
                follows = partial(_follows, usual_ns=usual_ns)
                near = partial(_follows, usual_ns=usual_ns, far_ns=_LONE_NS)
                if all(near(a, b) for a, b in pairwise(known)):
                    return known
                earlier = known[: known.index(chain[0]) + 1]
                return _longest(earlier, follows) + chain[1:]
        return _longest(known, _rises) if len(known) >= _MOST_WAITING else None

    def _returns(self, stamp: _Stamp) -> bool:
        """Whether a stamp shows that the newest one with a place was a fault.

        It continues from before a jump; or only one has a place, which nothing has confirmed.
        """
        before, last = self._before_jump, self._last
        assert last is not None
        if before is None:
            alone = not (self._intervals_ns or self.steps)
            return alone and not self._waits and _rises(stamp, last)
        jumped_ns = _per_item_ns(before, last)
        return _rises(before, stamp) and jumped_ns > _USUAL_RATIO * _per_item_ns(before, stamp)

    def _stepped(self, chain: list[_Stamp]) -> list[Placed]:
        last, first = self._last, chain[0]
        assert last is not None
        begun = [_per_item_ns(a, b) for a, b in pairwise(chain)]
        if self._before_jump is not None and self._returns(first):
            self._intervals_ns.pop()
            begun = [_per_item_ns(self._before_jump, first)]
        usual_ns = self._median_ns or min(begun, default=_UNKNOWN_NS)
        elapsed_ns = max(round((first.number - last.number) * usual_ns), 1)
        off_ns = first.stamp_ns - last.stamp_ns - elapsed_ns
        if not _rises(last, first) or self._unnoticed(last, first):
            self._shift_ns = self._time_ns + elapsed_ns - first.stamp_ns
        elif first.stamp_ns > self._time_ns:
            self._shift_ns = 0
        step = ClockStep(first.number, off_ns, self._shift_ns, first.stamp_ns + self._shift_ns)
        self.steps.append(step)
        self._last = self._before_jump = None  # intervals do not span a step
        return self._placed(chain, step)

    def _unnoticed(self, last: _Stamp, first: _Stamp) -> bool:
        """Whether a recorder kept receiving while the clock jumped forwards."""
        if last.received_ns is None or first.received_ns is None or not self._received_ns:
            return False
        per_item_ns = (first.received_ns - last.received_ns) / (first.number - last.number)
        return 0 <= per_item_ns <= _RECEIVED_RATIO * median_low(self._received_ns)

    def _placed(self, chain: list[_Stamp], step: ClockStep | None = None) -> list[Placed]:
        """Gives stamps their place; those that waited and are not among them are left out."""
        if self._waits:
            self._drop([waiting for waiting in self._waiting if waiting not in chain], chain)
        self._waiting.clear()
        placed = []
        for stamp in chain:
            if self._last is not None:
                self._learn(self._last, stamp)
            self._last, self._time_ns = stamp, stamp.stamp_ns + self._shift_ns
            newest = stamp is chain[-1]
            if self._waits or newest:
                placed.append(Placed(stamp.number, stamp.stamp_ns, self._time_ns, step))
                step = None
        return placed

    def _learn(self, last: _Stamp, stamp: _Stamp) -> None:
        per_item_ns = _per_item_ns(last, stamp)
        jumps = per_item_ns > _USUAL_RATIO * self._usual_ns(0.0)
        self._before_jump = last if jumps else None
        self._intervals_ns.append(per_item_ns)
        if last.received_ns is not None and stamp.received_ns is not None:
            since_ns = stamp.received_ns - last.received_ns
            self._received_ns.append(since_ns / (stamp.number - last.number))

    def _wait(self, stamp: _Stamp) -> None:
        self._waiting.append(stamp)
        if not self._waits:
            self._count_fault(stamp, self._last)
        if len(self._waiting) > _MOST_WAITING:
            oldest = self._waiting.pop(0)
            if self._waits:
                self._drop([oldest], self._waiting)

    def _drop(self, stamps: Sequence[_Stamp], chain: Sequence[_Stamp]) -> None:
        for stamp in stamps:
            before = [two for two in chain if two.number < stamp.number]
            after = next((two for two in chain if two.number > stamp.number), None)
            self._count_fault(stamp, before[-1] if before else self._last or after)

    def _count_fault(self, stamp: _Stamp, beside: _Stamp | None) -> None:
        """Counts a stamp that is left out, by its neighbour that has a place."""
        by_ns = 0 if beside is None else stamp.stamp_ns - beside.stamp_ns
        fault = StampFault.AHEAD if by_ns > 0 else StampFault.EARLY
        fault = StampFault.REPEATED if by_ns == 0 else fault
        self._counts[fault] += 1
        self._left_out(stamp.number, fault)
        self._example = (
            self._example or f"number {stamp.number} ({stamp.stamp_ns} ns), which {fault}"
        )


def in_time(
    items: Iterable[T],
    stamp_of: Callable[[T], int],
    clock: SteadyClock,
    received_of: Callable[[T], int] | None = None,
) -> Iterator[Timed[T]]:
    """The items of a stream that have a time, with it; a dozen of them wait at most.

    Args:
        stamp_of: the stamp of an item, ns.
        clock: a clock that waits; it has the report afterwards.
        received_of: when a recorder received an item, ns; None if unknown.
    """
    waiting: dict[int, T] = {}

    def ready(placed: Sequence[Placed]) -> Iterator[Timed[T]]:
        for place in placed:
            yield Timed(
                waiting[place.number], place.number, place.stamp_ns, place.time_ns, place.step
            )
        if placed:
            waiting.clear()

    for number, item in enumerate(items):
        waiting[number] = item
        waiting.pop(number - _MOST_WAITING - 1, None)
        yield from ready(clock.take(stamp_of(item), received_of and received_of(item)))
    yield from ready(clock.end())


def _per_item_ns(a: _Stamp, b: _Stamp) -> float:
    return (b.stamp_ns - a.stamp_ns) / (b.number - a.number)


def _rises(a: _Stamp, b: _Stamp) -> bool:
    return a.stamp_ns < b.stamp_ns


def _is_far(a: _Stamp, b: _Stamp, usual_ns: float, far_ns: int = _FAR_NS) -> bool:
    between_ns = _USUAL_RATIO * usual_ns * (b.number - a.number - 1)
    return b.stamp_ns - a.stamp_ns > max(_FAR_RATIO * usual_ns, far_ns) + between_ns


def _follows(a: _Stamp, b: _Stamp, usual_ns: float, far_ns: int = _FAR_NS) -> bool:
    return _rises(a, b) and not _is_far(a, b, usual_ns, far_ns)


def _alike(a: _Stamp, b: _Stamp, usual_ns: float) -> bool:
    return usual_ns <= _USUAL_RATIO * _per_item_ns(a, b) <= _USUAL_RATIO**2 * usual_ns


def _longest(
    stamps: Sequence[_Stamp],
    linked: Callable[[_Stamp, _Stamp], bool],
    first: _Stamp | None = None,
) -> list[_Stamp]:
    """The longest chain of stamps that ends in the newest, each linked to the one before.

    Of chains of a length, that of the stamps that came first.

    Args:
        first: with what the chain begins; None for any.

    Returns:
        The chain; empty if there is none.
    """
    chains: list[list[_Stamp]] = []
    for at, stamp in enumerate(stamps):
        before = [chains[k] for k in range(at) if chains[k] and linked(stamps[k], stamp)]
        alone = [] if first is not None and stamp is not first else [stamp]
        chains.append([*max(before, key=len), stamp] if before else alone)
    return chains[-1] if chains else []
