"""Pairs the images of two topics by stamp, with a tolerance learnt from the bag itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from engram.counts import counted
from engram.errors import SequenceError

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
        content: the image, however it is stored; a text says why it cannot be used.
    """

    number: int
    stamp_ns: int
    content: T | str


@dataclass(slots=True)
class Pairing:
    """What became of the images of a pass through the bag.

    Attributes:
        tolerance_ns: largest offset of a pair.
        left, right: images met on each topic.
        paired: pairs of one instant.
        largest_offset_ns: largest offset among them.
        unusable: images that could not be decoded or do not fit.
        backwards: images whose stamp does not rise.
    """

    tolerance_ns: int
    left: int = 0
    right: int = 0
    paired: int = 0
    largest_offset_ns: int = 0
    unusable: int = 0
    backwards: int = 0

    def text(self) -> str:
        """For people, in one line."""
        share = 100 * self.paired / self.left if self.left else 0.0
        facts = [
            f"{self.paired} of {counted(self.left, 'left image')} paired ({share:.1f} %), at most "
            f"{self.largest_offset_ns / 1e6:.3f} ms apart (tolerance "
            f"{self.tolerance_ns / 1e6:.3f} ms)"
        ]
        if self.backwards:
            facts.append(
                f"{counted(self.backwards, 'image')} left out whose stamp does not increase"
            )
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
    interval_ns = int(np.median(np.diff(left))) if len(left) > 1 else 2 * most_ns
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
) -> Iterator[tuple[Shot[T], Shot[T] | None]]:
    """Each left image whose stamp rises, with the nearest right one within the tolerance.

    Both topics are read side by side, so that memory stays flat whatever the order of the bag.

    Args:
        left, right: the images of each topic.
        pairing: counts what becomes of them.
    """
    rights = _rising(right, pairing, "right")
    waiting = next(rights, None)
    for shot in _rising(left, pairing, "left"):
        while waiting is not None and waiting.stamp_ns < shot.stamp_ns - pairing.tolerance_ns:
            waiting = next(rights, None)
        if waiting is None or waiting.stamp_ns > shot.stamp_ns + pairing.tolerance_ns:
            yield shot, None
            continue
        offset_ns = abs(waiting.stamp_ns - shot.stamp_ns)
        pairing.paired += 1
        pairing.largest_offset_ns = max(pairing.largest_offset_ns, offset_ns)
        yield shot, waiting
        waiting = next(rights, None)
    for _ in rights:
        pass  # so that they are counted


def _rising(shots: Iterator[Shot[T]], pairing: Pairing, side: str) -> Iterator[Shot[T]]:
    last_ns: int | None = None
    for shot in shots:
        setattr(pairing, side, getattr(pairing, side) + 1)
        if last_ns is not None and shot.stamp_ns <= last_ns:
            pairing.backwards += 1
            continue
        last_ns = shot.stamp_ns
        yield shot
