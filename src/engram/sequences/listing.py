"""Listing of a layout on disk: numbered places, each a pair of files or a fault.

Each reader turns its layout into a listing. Faults are only noted there, so `--frames` and
`--skip-bad` mean the same for every layout. Stamps are read from decimal seconds, dates or
nanoseconds, without rounding, as whole nanoseconds.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

from engram.counts import counted
from engram.errors import SequenceError
from engram.sequences.images import IMAGE_SUFFIXES
from engram.untrusted import read_text

# Stamps after the year 2200 are refused: they soon exceed 64 bits.
_MAX_STAMP_NS = 2**63 - 1

# Digits of a time since 1970 in other units than seconds.
_UNITS = {13: "milliseconds", 16: "microseconds", 19: "nanoseconds"}
_SECONDS = re.compile(r"[+-]?\d{1,12}(\.\d{0,30})?([eE][+-]?\d{1,2})?", re.ASCII)
_NANOSECONDS = re.compile(r"\d{1,19}", re.ASCII)
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,12}))?Z?", re.ASCII)


@dataclass(frozen=True, slots=True)
class PairFiles:
    """Two image files that make a stereo pair."""

    stamp_ns: int
    left: Path
    right: Path


# A place without a usable pair holds the reason, as text.
Listing = Sequence[PairFiles | str]


@dataclass(frozen=True, slots=True)
class StampedFile:
    """An image file of one camera; `fault` says why it cannot be used, "" if it can."""

    stamp_ns: int
    path: Path
    fault: str | None = None


class StampFault(str):
    """The fault of a place whose stamp is not later than the last good one.

    Attributes:
        backwards: whether it is earlier, not equal.
    """

    backwards: bool

    def __new__(cls, text: str, *, backwards: bool) -> StampFault:
        """The fault as a text."""
        fault = super().__new__(cls, text)
        fault.backwards = backwards
        return fault


def read_stamps(path: Path, parse: Callable[[str], int | None]) -> list[int]:
    """The stamps of a file with one stamp a line, ns. Empty lines at the end are ignored.

    Raises:
        SequenceError: as `read_text`; a line is not a stamp, or there is none.
    """
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
    """The image files of a folder by name; hidden files and other file types are skipped.

    Raises:
        SequenceError: the folder does not exist, cannot be read, or holds no image.
    """
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
    """The images of a folder whose names are frame numbers, such as `000017.png`.

    Raises:
        SequenceError: as `image_files`; a name is not a number; two images have the same number.
    """
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
    faults = _order_faults(
        stamps_ns, stamps_file, [f"line {at + 1}" for at in range(len(stamps_ns))]
    )
    for number, (stamp_ns, fault) in enumerate(zip(stamps_ns, faults, strict=True)):
        missing = [
            f"image {number} is missing in {next(iter(side.values())).parent}"
            for side in (left, right)
            if number not in side
        ]
        if missing:
            places.append(f"{'; '.join(missing)} ({stamps_file.name} has a stamp for it)")
        else:
            places.append(fault or PairFiles(stamp_ns, left[number], right[number]))
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
        right: the right images likewise.
        tolerance_ns: largest difference of stamps within a pair, ns.
        sources: the file or folder that gave the left and the right stamps, for messages.
    """
    lefts, rights = _in_order(left, sources[0]), _in_order(right, sources[1])
    right_files = [item for item in rights if isinstance(item, StampedFile)]
    right_stamps = [file.stamp_ns for file in right_files]
    taken: set[int] = set()
    places: list[PairFiles | str] = []
    for item in lefts:
        if isinstance(item, str):
            places.append(item)
            continue
        index = _nearest(right_stamps, item.stamp_ns)
        off_ns = abs(right_stamps[index] - item.stamp_ns) if index is not None else None
        if index is None or off_ns is None or off_ns > tolerance_ns or index in taken:
            nearest = "there is none" if off_ns is None else f"the nearest is {off_ns / 1e6:.3f} ms"
            places.append(
                f"{item.path}: no right image within {tolerance_ns / 1e6:g} ms ({nearest} off)"
            )
            continue
        taken.add(index)
        other = right_files[index]
        faults = [file.fault for file in (item, other) if file.fault]
        places.append("; ".join(faults) or PairFiles(item.stamp_ns, item.path, other.path))
    places += [item for item in rights if isinstance(item, str)]
    places += [
        f"{file.path}: no left image within {tolerance_ns / 1e6:g} ms"
        for index, file in enumerate(right_files)
        if index not in taken
    ]
    return places


def usable_pairs(
    places: Listing, skip_bad: bool, where: Path, choose: Callable[[Listing], Listing]
) -> tuple[list[PairFiles], list[str]]:
    """The pairs of the chosen places, and the faults of the others.

    Raises:
        SequenceError: a chosen place is bad and `skip_bad` is not set, or no pair is left.
    """
    chosen = choose(places)
    reasons = [place for place in chosen if isinstance(place, str)]
    pairs = [place for place in chosen if isinstance(place, PairFiles)]
    if reasons and pairs and not skip_bad:
        more = f" (and {len(reasons) - 1} more such faults)" if len(reasons) > 1 else ""
        raise SequenceError(f"{reasons[0]}{more}; leave them out with --skip-bad")
    if not pairs:
        if places and not chosen:
            raise SequenceError(
                f"{where}: none of its {counted(len(places), 'pair')} is chosen, 0 to "
                f"{len(places) - 1}; change --frames, --from or --to"
            )
        why = f"; first fault: {reasons[0]}" if reasons else ""
        raise SequenceError(
            f"{where}: no pair is left of {len(places)} in the drive, {len(chosen)} of them "
            f"chosen{why}"
        )
    return pairs, reasons


def _in_order(items: Iterable[StampedFile | str], source: Path) -> list[StampedFile | str]:
    """The items, with a fault in place of those whose stamps do not rise."""
    listed = list(items)
    files = [item for item in listed if isinstance(item, StampedFile)]
    names = [f"image {file.path.name}" for file in files]
    faults = iter(_order_faults([file.stamp_ns for file in files], source, names))
    return [item if isinstance(item, str) else next(faults) or item for item in listed]


def _nearest(stamps_ns: Sequence[int], stamp_ns: int) -> int | None:
    after = bisect_left(stamps_ns, stamp_ns)
    around = [index for index in (after - 1, after) if 0 <= index < len(stamps_ns)]
    return min(around, key=lambda index: abs(stamps_ns[index] - stamp_ns), default=None)


def _order_faults(stamps_ns: Sequence[int], source: Path, names: Sequence[str]) -> list[str | None]:
    """The fault of each stamp that is not above the last good one."""
    faults: list[str | None] = []
    last_ns: int | None = None
    for stamp_ns, name in zip(stamps_ns, names, strict=True):
        if last_ns is None or stamp_ns > last_ns:
            last_ns = stamp_ns
            faults.append(None)
            continue
        how = "repeats the stamp" if stamp_ns == last_ns else "is stamped before the stamp"
        text = f"{source}: {name} ({stamp_ns} ns) {how} of the one before ({last_ns} ns)"
        faults.append(StampFault(text, backwards=stamp_ns < last_ns))
    return faults
