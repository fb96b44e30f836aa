"""Pairs the images of two topics by stamp, with a tolerance learnt from the bag itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from engram.counts import counted
from engram.errors import SequenceError
from engram.sequences.clocks import StampReport, SteadyClock, Timed, in_time, joined
from engram.sequences.pairs import paired

T = TypeVar("T")

# Stamps of one trigger differ by rounding at most.
_LEAST_TOLERANCE_NS = 100_000
# Bulk of the offsets, and how much more a pair may be apart.
_BULK_PERCENT, _ALLOWANCE = 95, 3


@dataclass(frozen=True, slots=True)
class Shot(Generic[T]):
    """One image of one topic.

    Attributes:
        number: its place on the topic, from 0.
        stamp_ns: capture time, ns.
        received_ns: when the recorder received it, ns.
        content: the image, however it is stored.
    """

    number: int
    stamp_ns: int
    received_ns: int
    content: T


@dataclass(slots=True)
class Pairing:
    """Outcome of pairing the images in a pass through the bag.

    Attributes:
        tolerance_ns: largest offset of a pair.
        left, right: images met on each topic.
        paired: pairs of one instant.
        largest_offset_ns: largest offset among them.
        unusable: images that could not be decoded or do not fit.
        placed: left images that have a time, and so a right one or none.
        complete: whether the pass reached the end of the bag; if not, some images still waited.
        clocks: of the left and of the right stamps.
    """

    tolerance_ns: int
    left: int = 0
    right: int = 0
    paired: int = 0
    largest_offset_ns: int = 0
    unusable: int = 0
    placed: int = 0
    complete: bool = False
    clocks: tuple[SteadyClock, SteadyClock] = field(
        default_factory=lambda: (SteadyClock(waits=True), SteadyClock(waits=True))
    )

    @property
    def stamps(self) -> StampReport:
        """What happened to the stamps of the left images, and of right ones without theirs."""
        return joined(*(clock.report for clock in self.clocks))

    def text(self) -> str:
        """For people, in one line."""
        met = self.left if self.complete else self.placed
        share = 100 * self.paired / met if met else 0.0
        facts = [
            f"{self.paired} of {counted(met, 'left image')} paired ({share:.1f} %), at most "
            f"{self.largest_offset_ns / 1e6:.3f} ms apart (tolerance "
            f"{self.tolerance_ns / 1e6:.3f} ms)"
        ]
        if self.unusable:
            facts.append(f"{counted(self.unusable, 'image')} could not be used")
        return "; ".join(facts)


def learnt_tolerance(left_ns: Sequence[int], right_ns: Sequence[int], most_ns: int) -> int:
    """Largest offset at which two images count as of one instant, ns.

    Three times the offset that 95 % of the images stay below, but less than half of the interval
    between images.

    Args:
        left_ns, right_ns: stamps of the first images of each topic.
        most_ns: the largest that may be learnt.

    Raises:
        SequenceError: no images of the two topics are of one instant.
    """
    left, right = np.sort(np.array(left_ns, np.int64)), np.sort(np.array(right_ns, np.int64))
    after = np.searchsorted(right, left).clip(1, max(len(right) - 1, 1))
    around = np.stack([right[(after - 1).clip(0)], right[after.clip(0, len(right) - 1)]])
    offsets = np.abs(around - left).min(axis=0)
    rising_ns = np.diff(np.array(left_ns, np.int64))
    rising_ns = rising_ns[rising_ns > 0]  # where a clock was set back, others lie between
    interval_ns = int(np.median(rising_ns)) if len(rising_ns) else 2 * most_ns
    most_ns = min(most_ns, max(interval_ns // 2, 1))
    near = offsets[offsets <= most_ns]
    if not len(near):
        raise SequenceError(
            f"left and right images are not synchronised: typically "
            f"{np.median(offsets) / 1e6:.1f} ms apart, at most {most_ns / 1e6:.1f} ms is a pair; "
            "are these the topics of one stereo camera, triggered together?"
        )
    learnt = _ALLOWANCE * int(np.percentile(near, _BULK_PERCENT))
    return min(max(learnt, _LEAST_TOLERANCE_NS), most_ns)


def pairs_of(
    left: Iterator[Shot[T]], right: Iterator[Shot[T]], pairing: Pairing
) -> Iterator[tuple[Timed[Shot[T]], Shot[T] | None]]:
    """Each left image that has a time, with the right one of its instant.

    Both topics are read side by side, so that memory stays flat whatever the order of the bag.

    Args:
        left, right: the images of each topic.
        pairing: counts what becomes of them.
    """
    timed = [
        in_time(shots, lambda one: one.stamp_ns, clock, lambda one: one.received_ns)
        for shots, clock in zip((left, right), pairing.clocks, strict=True)
    ]
    for shot, other in paired(timed[0], timed[1], pairing.tolerance_ns):
        if shot is None:
            continue
        pairing.placed += 1
        if other is not None:
            pairing.paired += 1
            offset_ns = abs(other.stamp_ns - shot.stamp_ns)
            if offset_ns <= pairing.tolerance_ns:
                pairing.largest_offset_ns = max(pairing.largest_offset_ns, offset_ns)
        yield shot, None if other is None else other.item
    pairing.complete = True
