"""What a layout on disk amounts to: numbered places, each a pair of files or a fault.

Each reader turns its layout into a listing; what is bad about a place is noted there and decided
upon later, so that `--frames` and `--skip-bad` mean the same for every layout.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from engram.errors import SequenceError
from engram.sequences.images import IMAGE_SUFFIXES


@dataclass(frozen=True, slots=True)
class PairFiles:
    """Two image files that make a stereo pair."""

    stamp_ns: int
    left: Path
    right: Path


@dataclass(frozen=True, slots=True)
class BadPlace:
    """A place of the drive without a usable pair, and why."""

    reason: str


Listing = Sequence[PairFiles | BadPlace]


@dataclass(frozen=True, slots=True)
class StampedFile:
    """An image file of one camera; `fault` says why it cannot be used, if so."""

    stamp_ns: int
    path: Path
    fault: str | None = None


def image_files(folder: Path) -> list[Path]:
    """The image files of a folder by name; hidden files and files of other kinds are passed over.

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
        SequenceError: as `image_files`; a name is no number; two images have the same number.
    """
    numbered: dict[int, Path] = {}
    for path in image_files(folder):
        if not (path.stem.isascii() and path.stem.isdecimal() and len(path.stem) <= 18):
            raise SequenceError(
                f"{path}: the name is no frame number; rename the image or move it away"
            )
        other = numbered.setdefault(int(path.stem), path)
        if other is not path:
            raise SequenceError(f"{path}: is frame {int(path.stem)} again, beside {other.name}")
    return numbered


def pair_by_number(
    stamps_ns: Sequence[int], left: dict[int, Path], right: dict[int, Path], stamps_file: Path
) -> Listing:
    """Listing of a layout in which line i of a file of stamps belongs to image i on both sides."""
    places: list[PairFiles | BadPlace] = []
    order = _OrderCheck(stamps_file)
    for number, stamp_ns in enumerate(stamps_ns):
        fault = order.fault(stamp_ns, f"line {number + 1}")
        missing = [
            f"image {number} is missing in {next(iter(side.values())).parent}"
            for side in (left, right)
            if number not in side
        ]
        if missing:
            places.append(BadPlace(f"{'; '.join(missing)} ({stamps_file.name} has a stamp for it)"))
        elif fault:
            places.append(BadPlace(fault))
        else:
            places.append(PairFiles(stamp_ns, left[number], right[number]))
    for number in sorted(number for number in {*left, *right} if number >= len(stamps_ns)):
        extra = " and ".join(str(side[number]) for side in (left, right) if number in side)
        places.append(
            BadPlace(f"{extra}: extra image, {stamps_file.name} has only {len(stamps_ns)} stamps")
        )
    return places


def pair_by_stamp(
    left: Iterable[StampedFile | BadPlace],
    right: Iterable[StampedFile | BadPlace],
    tolerance_ns: int,
    sources: tuple[Path, Path],
) -> Listing:
    """Listing of a layout in which each side has stamps of its own.

    A left image goes with the nearest right one within the tolerance; the pair has the left stamp.

    Args:
        left: the left images in the order of their files.
        right: the right images likewise.
        tolerance_ns: largest difference within a pair.
        sources: the file or folder that gave the left and the right stamps, for messages.
    """
    lefts = _in_order(left, sources[0])
    rights = _in_order(right, sources[1])
    right_files = [item for item in rights if isinstance(item, StampedFile)]
    right_stamps = [file.stamp_ns for file in right_files]
    taken: set[int] = set()
    places: list[PairFiles | BadPlace] = []
    for item in lefts:
        if isinstance(item, BadPlace):
            places.append(item)
            continue
        index = _nearest(right_stamps, item.stamp_ns)
        off_ns = abs(right_stamps[index] - item.stamp_ns) if index is not None else None
        if index is None or off_ns is None or off_ns > tolerance_ns or index in taken:
            nearest = "there is none" if off_ns is None else f"the nearest is {off_ns / 1e6:.3f} ms"
            places.append(
                BadPlace(
                    f"{item.path}: no right image within {tolerance_ns / 1e6:g} ms ({nearest} off)"
                )
            )
            continue
        taken.add(index)
        other = right_files[index]
        faults = [file.fault for file in (item, other) if file.fault]
        places.append(
            BadPlace("; ".join(faults))
            if faults
            else PairFiles(item.stamp_ns, item.path, other.path)
        )
    places += [item for item in rights if isinstance(item, BadPlace)]
    places += [
        BadPlace(f"{file.path}: no left image within {tolerance_ns / 1e6:g} ms")
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
    reasons = [place.reason for place in chosen if isinstance(place, BadPlace)]
    if reasons and not skip_bad:
        more = f" (and {len(reasons) - 1} more such faults)" if len(reasons) > 1 else ""
        raise SequenceError(f"{reasons[0]}{more}; --skip-bad goes on without them")
    pairs = [place for place in chosen if isinstance(place, PairFiles)]
    if not pairs:
        why = f"; first fault: {reasons[0]}" if reasons else ""
        raise SequenceError(
            f"{where}: no pair is left of {len(places)} in the drive, {len(chosen)} of them "
            f"chosen{why}"
        )
    return pairs, reasons


def _in_order(
    items: Iterable[StampedFile | BadPlace], source: Path
) -> list[StampedFile | BadPlace]:
    order = _OrderCheck(source)
    checked: list[StampedFile | BadPlace] = []
    for item in items:
        if isinstance(item, StampedFile):
            fault = order.fault(item.stamp_ns, f"image {item.path.name}")
            checked.append(BadPlace(fault) if fault else item)
        else:
            checked.append(item)
    return checked


def _nearest(stamps_ns: Sequence[int], stamp_ns: int) -> int | None:
    after = bisect_left(stamps_ns, stamp_ns)
    around = [index for index in (after - 1, after) if 0 <= index < len(stamps_ns)]
    return min(around, key=lambda index: abs(stamps_ns[index] - stamp_ns), default=None)


class _OrderCheck:
    """Stamps must rise; one that does not is a fault and does not count for those after it."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._last_ns: int | None = None

    def fault(self, stamp_ns: int, what: str) -> str | None:
        last_ns = self._last_ns
        if last_ns is None or stamp_ns > last_ns:
            self._last_ns = stamp_ns
            return None
        how = "repeats the stamp" if stamp_ns == last_ns else "is stamped before the stamp"
        return f"{self._source}: {what} ({stamp_ns} ns) {how} of the one before ({last_ns} ns)"
