"""Listing of a layout on disk: numbered places, each a pair of files or a fault.

Each reader turns its layout into a listing. Faults are only noted there, so `--frames` and
`skip_bad` mean the same for every layout. Stamps are read from decimal seconds, dates or
nanoseconds, without rounding, as whole nanoseconds.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from statistics import median_low
from typing import TypeVar

from engram.counts import counted
from engram.errors import SequenceError
from engram.sequences.clocks import ClockStep, StampFault, StampReport, SteadyClock, Timed, in_time
from engram.sequences.images import IMAGE_SUFFIXES
from engram.untrusted import read_text

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
        if abs(left.stamp_ns - right.stamp_ns) <= self._tolerance_ns:
            return True
        set_apart = left.time_ns - left.stamp_ns != right.time_ns - right.stamp_ns
        off_ns = abs(left.time_ns - right.time_ns - self._lag_ns)
        return (set_apart or self._loose) and off_ns <= self._slack_ns

    def is_nearer(self, left: Timed[L], right: Timed[R], found: Timed[R]) -> bool:
        off_ns, other_ns = (abs(left.stamp_ns - candidate.stamp_ns) for candidate in (right, found))
        return off_ns <= self._tolerance_ns and off_ns < other_ns

    def learn(self, left: Timed[L], right: Timed[R]) -> None:
        if self._loose or left.stamp_ns != left.time_ns or right.stamp_ns != right.time_ns:
            self._lag_ns = left.time_ns - right.time_ns
        self._loose, self._known = False, True

    @property
    def _slack_ns(self) -> int:
        """How far times of a pair may be apart, ns: nearly half an interval after a step."""
        if not self._loose or not self._intervals_ns:
            return self._tolerance_ns
        return max(self._tolerance_ns, median_low(self._intervals_ns) // 2 - 1)


# Stamps after the year 2200 are refused: they soon exceed 64 bits.
_MAX_STAMP_NS = 2**63 - 1

# Digits of a time since 1970 in other units than seconds.
_UNITS = {13: "milliseconds", 16: "microseconds", 19: "nanoseconds"}
_SECONDS = re.compile(r"[+-]?\d{1,12}(\.\d{0,30})?([eE][+-]?\d{1,2})?", re.ASCII)
_NANOSECONDS = re.compile(r"\d{1,19}", re.ASCII)
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,12}))?Z?", re.ASCII)


@dataclass(frozen=True, slots=True)
class PairFiles:
    """Two image files that make a stereo pair.

    Attributes:
        stamp_ns: their time by the rule of `engram.sequences.clocks`: the stamp of the left one,
            unless the clock was set back before.
        step: where the clock was set just before the pair; None elsewhere.
    """

    stamp_ns: int
    left: Path
    right: Path
    step: ClockStep | None = None


# A place without a usable pair holds the reason, as text.
Listing = Sequence[PairFiles | str]


@dataclass(frozen=True, slots=True)
class StampedFile:
    """An image file of one camera; `fault` says why it cannot be used, "" if it can."""

    stamp_ns: int
    path: Path
    fault: str | None = None


class WrongStamp(str):
    """The fault of a place that is left out for its stamp, whatever `skip_bad` says."""

    fault: StampFault

    def __new__(cls, text: str, fault: StampFault) -> WrongStamp:
        """The fault as a text."""
        wrong = super().__new__(cls, text)
        wrong.fault = fault
        return wrong


def stamp_report(places: Listing) -> StampReport:
    """What happened to the stamps of a listing."""
    wrong = [place for place in places if isinstance(place, WrongStamp)]
    faults = [place.fault for place in wrong]
    return StampReport(
        len(places),
        faults.count(StampFault.REPEATED),
        faults.count(StampFault.EARLY),
        faults.count(StampFault.AHEAD),
        next(iter(wrong), ""),
        steps=tuple(place.step for place in places if isinstance(place, PairFiles) and place.step),
    )


def read_stamps(path: Path, parse: Callable[[str], int | None]) -> list[int]:
    """The stamps of a file with one stamp a line, ns. Empty lines at the end are ignored."""
    lines = read_text(path).rstrip().splitlines()
    stamps_ns: list[int] = []
    for number, line in enumerate(lines, start=1):
        stamp_ns = parse(line.strip())
        if stamp_ns is None:
            unit = _UNITS.get(len(line.strip().partition(".")[0])) if line[:1].isdigit() else None
            asked = f"; is it in {unit}? stamps here are in seconds: divide them" if unit else ""
            raise SequenceError(f"{path}: line {number} is not a stamp: {line[:60]!r}{asked}")
        stamps_ns.append(stamp_ns)
    if not stamps_ns:
        raise SequenceError(f"{path}: holds no stamp")
    return stamps_ns


def seconds_as_ns(text: str) -> int | None:
    """Nanoseconds of decimal seconds such as `1.044989e-01`; None if the text is not a number."""
    if not _SECONDS.fullmatch(text):
        return None
    return _in_range(int((Decimal(text) * 1_000_000_000).to_integral_value()))


def nanoseconds(text: str) -> int | None:
    """Whole nanoseconds; None if the text is not a whole number."""
    return _in_range(int(text)) if _NANOSECONDS.fullmatch(text) else None


def date_as_ns(text: str) -> int | None:
    """A UTC date such as `2011-09-26 13:02:25.967790592` as ns since 1970; None if malformed."""
    match = _DATE.fullmatch(text)
    if not match:
        return None
    day, time, fraction = match.groups()
    try:
        whole = datetime.fromisoformat(f"{day}T{time}").replace(tzinfo=UTC)
    except ValueError:
        return None
    nanos = int((fraction or "0").ljust(9, "0")[:9])
    return _in_range(int(whole.timestamp()) * 1_000_000_000 + nanos)


def _in_range(stamp_ns: int) -> int | None:
    return stamp_ns if abs(stamp_ns) <= _MAX_STAMP_NS else None


def image_files(folder: Path) -> list[Path]:
    """The image files of a folder by name; hidden files and other file types are skipped."""
    try:
        entries = sorted(folder.iterdir())
    except FileNotFoundError:
        raise SequenceError(f"{folder}: the image folder is missing") from None
    except OSError as error:
        raise SequenceError(f"{folder}: cannot be read: {error.strerror}") from error
    files = [
        entry
        for entry in entries
        if entry.suffix.lower() in IMAGE_SUFFIXES and not entry.name.startswith(".")
    ]
    if not files:
        raise SequenceError(
            f"{folder}: no images here; known endings: {' '.join(sorted(IMAGE_SUFFIXES))}"
        )
    return files


def numbered_files(folder: Path) -> dict[int, Path]:
    """The images of a folder whose names are frame numbers, such as `000017.png`."""
    numbered: dict[int, Path] = {}
    for path in image_files(folder):
        if not (path.stem.isascii() and path.stem.isdecimal() and len(path.stem) <= 18):
            raise SequenceError(
                f"{path}: the name is not a frame number; rename the image or move it away"
            )
        other = numbered.setdefault(int(path.stem), path)
        if other is not path:
            raise SequenceError(f"{path}: frame {int(path.stem)} exists twice, see {other.name}")
    return numbered


def pair_by_number(
    stamps_ns: Sequence[int], left: dict[int, Path], right: dict[int, Path], stamps_file: Path
) -> Listing:
    """Listing of a layout in which line i of a file of stamps belongs to image i on both sides."""
    places: list[PairFiles | str] = []
    timed = _timed(stamps_ns, [f"line {at + 1}" for at in range(len(stamps_ns))], stamps_file)
    for number, place in enumerate(timed):
        missing = [
            f"image {number} is missing in {next(iter(side.values())).parent}"
            for side in (left, right)
            if number not in side
        ]
        if missing:
            places.append(f"{'; '.join(missing)} ({stamps_file.name} has a stamp for it)")
        else:
            places.append(
                PairFiles(place.time_ns, left[number], right[number], place.step)
                if isinstance(place, Timed)
                else place
            )
    for number in sorted(number for number in {*left, *right} if number >= len(stamps_ns)):
        extra = " and ".join(str(side[number]) for side in (left, right) if number in side)
        places.append(f"{extra}: extra image, {stamps_file.name} has only {len(stamps_ns)} stamps")
    return places


def pair_by_stamp(
    left: Iterable[StampedFile | str],
    right: Iterable[StampedFile | str],
    tolerance_ns: int,
    sources: tuple[Path, Path],
) -> Listing:
    """Listing of a layout in which each side has its own stamps.

    Each left image is paired with the nearest right one within the tolerance; the pair has the left
    stamp.

    Args:
        left: the left images or their faults, in the order of their files.
        tolerance_ns: largest difference of stamps within a pair, ns.
        sources: the file or folder that gave the left and the right stamps, for messages.
    """
    lefts, rights = _timed_files(left, sources[0]), _timed_files(right, sources[1])
    partners: dict[int, Timed[StampedFile]] = {}
    alone: list[Timed[StampedFile]] = []
    sides = [iter([item for item in side if isinstance(item, Timed)]) for side in (lefts, rights)]
    for own, partner in paired(sides[0], sides[1], tolerance_ns):
        if own is not None and partner is not None:
            partners[own.number] = partner
        elif partner is not None:
            alone.append(partner)
    wrong = [right for right in rights if isinstance(right, WrongStamp)]
    within = f"within {tolerance_ns / 1e6:g} ms"
    places: list[PairFiles | str] = []
    for item in lefts:
        if isinstance(item, str):
            places.append(item)
        elif (match := partners.get(item.number)) is not None:
            places.append(_pair(item, match))
        elif wrong:  # that of its partner
            places.append(wrong.pop(0))
        else:
            off = _nearest_text(item.stamp_ns, rights)
            places.append(f"{item.item.path}: no right image {within} ({off})")
    # What is wrong on both sides, or has no partner for that, is one fault.
    named = sum(isinstance(left, WrongStamp) for left in lefts)
    places += [
        right for right in rights if isinstance(right, str) and not isinstance(right, WrongStamp)
    ]
    places += wrong[named:]
    places += [f"{right.item.path}: no left image {within}" for right in alone[named:]]
    return places


def _pair(left: Timed[StampedFile], right: Timed[StampedFile]) -> PairFiles | str:
    faults = [side.item.fault for side in (left, right) if side.item.fault]
    step = left.step or right.step
    return "; ".join(faults) or PairFiles(left.time_ns, left.item.path, right.item.path, step)


def usable_pairs(
    places: Listing, skip_bad: bool, where: Path, choose: Callable[[Listing], Listing]
) -> tuple[list[PairFiles], list[str]]:
    """The pairs of the chosen places, and the faults of the others.

    Pairs with a wrong stamp are left out in any case.
    """
    chosen = choose(places)
    reasons = [place for place in chosen if isinstance(place, str)]
    bad = [reason for reason in reasons if not isinstance(reason, WrongStamp)]
    pairs = [place for place in chosen if isinstance(place, PairFiles)]
    if bad and pairs and not skip_bad:
        more = f" (and {len(bad) - 1} more such faults)" if len(bad) > 1 else ""
        raise SequenceError(f"{bad[0]}{more}; leave them out with --set drive.skip_bad=true")
    if not pairs:
        if places and not chosen:
            raise SequenceError(
                f"{where}: none of its {counted(len(places), 'pair')} is chosen, 0 to "
                f"{len(places) - 1}; change --frames, drive.from_ or drive.to"
            )
        why = f"; first fault: {reasons[0]}" if reasons else ""
        raise SequenceError(
            f"{where}: none of the {len(chosen)} chosen pairs can be used, of {len(places)} in "
            f"the drive{why}"
        )
    return pairs, reasons


def _timed_files(
    items: Iterable[StampedFile | str], source: Path
) -> list[Timed[StampedFile] | str]:
    """The items with their times, with a fault in place of those with a wrong stamp."""
    listed = list(items)
    files = [item for item in listed if isinstance(item, StampedFile)]
    names = [f"image {file.path.name}" for file in files]
    timed = iter(_timed([file.stamp_ns for file in files], names, source))
    files_in_time: list[Timed[StampedFile] | str] = []
    for item in listed:
        if isinstance(item, str):
            files_in_time.append(item)
            continue
        placed = next(timed)
        if isinstance(placed, Timed):
            files_in_time.append(
                Timed(item, placed.number, placed.stamp_ns, placed.time_ns, placed.step)
            )
        else:
            files_in_time.append(placed)
    return files_in_time


def _nearest_text(stamp_ns: int, others: Iterable[Timed[StampedFile] | str]) -> str:
    off_ns = [abs(other.stamp_ns - stamp_ns) for other in others if isinstance(other, Timed)]
    return f"the nearest is {min(off_ns) / 1e6:.3f} ms off" if off_ns else "there is none"


def _timed(
    stamps_ns: Sequence[int], names: Sequence[str], source: Path
) -> list[Timed[int] | WrongStamp]:
    times: list[Timed[int] | WrongStamp | None] = [None] * len(stamps_ns)

    def left_out(number: int, fault: StampFault) -> None:
        text = f"{source}: {names[number]} ({stamps_ns[number]} ns) {fault}"
        times[number] = WrongStamp(text, fault)

    clock = SteadyClock(waits=True, left_out=left_out)
    for item in in_time(stamps_ns, lambda stamp_ns: stamp_ns, clock):
        times[item.number] = item
    return [item for item in times if item is not None]
