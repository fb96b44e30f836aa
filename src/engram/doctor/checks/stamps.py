"""Stamps: their order, their clock, gaps between them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from engram.doctor.examination import Array, Evidence
from engram.graph.clock import known_zone
from engram.graph.model import Clock

# Units in which somebody may have counted frames, ns.
_UNITS_NS = (1, 1_000, 1_000_000, 1_000_000_000)
# Intervals on either side with which one is compared.
_AROUND = 5


def faulty_share(seen: Evidence) -> float | None:
    """Share of the drive's frames that its reader left out for a wrong stamp."""
    return seen.read.faulty_share


def faulty(seen: Evidence) -> float | None:
    """Frames left out as they are stamped before, or far after, their neighbours."""
    return float(seen.read.faulty + seen.taken.faulty)


def repeated(seen: Evidence) -> float | None:
    """Frames with the stamp of the frame before."""
    return float(seen.read.repeated + seen.taken.repeated)


def steps(seen: Evidence) -> float | None:
    """How often the clock was set; not forwards, which cannot be distinguished from a pause."""
    shifts_ns = [0, *(one.shift_ns for one in (*seen.read.steps, *seen.taken.steps))]
    return float(sum(a != b for a, b in pairwise(shifts_ns)))


def counted(seen: Evidence) -> float | None:
    """Share of frames whose stamp is their number, in ns, µs, ms or s."""
    if seen.facts.step != 1 or len(seen) < seen.config.least_frames:
        return None
    stamps = np.array(seen.stamps_ns, np.int64)
    most = 0.0
    for unit_ns in _UNITS_NS:
        whole = (stamps % unit_ns == 0) & (stamps // unit_ns <= 10 * len(stamps))
        steps = np.diff(stamps) == unit_ns
        most = max(most, float(min(whole.mean(), steps.mean())))
    return most


def jump_s(seen: Evidence) -> float | None:
    """The longest interval, if it is not as long as others: stamps in another unit do not jump."""
    intervals_s = seen.intervals_s
    if not len(intervals_s):
        return None
    longest_s = float(intervals_s.max())
    return longest_s if longest_s > seen.config.gap_ratio * np.median(intervals_s) else 0.0


def gap_ratio(seen: Evidence) -> float | None:
    """The longest interval, in the median of those around it; steps of the clock do not count."""
    intervals_s = seen.intervals_s
    intervals_s = intervals_s[intervals_s <= seen.config.jump_s]
    if len(intervals_s) < seen.config.least_frames:
        return None
    return float((intervals_s / _usual(intervals_s)).max())


def rate_hz(seen: Evidence) -> float | None:
    """Frames per second."""
    intervals_s = seen.intervals_s
    if len(intervals_s) < seen.config.least_frames:
        return None
    return float(1 / max(float(np.median(intervals_s)), 1e-9))


def hours_unknown(seen: Evidence) -> float | None:
    """How much is unknown of two: that the stamps are UTC, and where on earth that was."""
    facts = seen.facts
    nowhere = facts.longitude_deg is None and known_zone(facts.zone) is None
    return float((facts.clock is not Clock.UTC) + nowhere)


def hour_given_by(seen: Evidence) -> str:
    """The options that determine the hour of the drive."""
    facts = seen.facts
    nowhere = facts.zone is None and facts.longitude_deg is None
    asked = ["--recorded-at"] if facts.clock is not Clock.UTC else []
    return "give " + " and ".join(asked + ["--zone or --longitude"] * nowhere)


def hours_needed(seen: Evidence) -> float | None:
    """The same, where missions by hour need it."""
    return hours_unknown(seen) if seen.facts.by_hour else None


def _usual(intervals_s: Array) -> Array:
    padded = np.pad(intervals_s, _AROUND, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1)
    return np.maximum(np.median(around, axis=1), 1e-9)
