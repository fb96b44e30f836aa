"""Drives stored as images: one reader of pairs for all layouts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration import Cameras
from engram.errors import ConfigError, SequenceError
from engram.frontend import StereoPair
from engram.geometry.rectification import Rectification, RemapTable
from engram.graph.model import Clock
from engram.odometry import MotionSource
from engram.sequences.calibrating import TELLING, check_no_view, check_sides, read_mask, scaled_by
from engram.sequences.images import image_bits, image_size, read_image
from engram.sequences.listing import (
    Listing,
    PairFiles,
    WrongStamp,
    stamp_report,
    usable_pairs,
)
from engram.sequences.motion import motion_of_files, stamp_facts_of_files
from engram.sequences.options import Channel, OpenOptions
from engram.sequences.sequence import SequenceInfo
from engram.untrusted import printable


@dataclass(frozen=True, slots=True, eq=False)
class ImageDrive:
    """The content of a layout, before the caller's options.

    Attributes:
        path: folder of the drive.
        info: facts from its files.
        cameras: the stereo pair.
        places: all its pairs and faults, in the order of time.
        read: decodes one image: path, width, height, channel → (height, width) uint8 grey.
    """

    path: Path
    info: SequenceInfo
    cameras: Cameras
    places: Listing
    read: Callable[[Path, int, int, Channel], NDArray[np.uint8]] = read_image


class ImageSequence:
    """A `StereoSequence` over image files. Pairs are decoded on demand.

    Attributes:
        info: what is known of the drive as a whole.
        cameras: its stereo pair, with the rectification of raw images.
        camera: its one camera, rectified.
        frames: the used frames of the drive.
        stamps: what happened to the stamps of the whole drive.

    Raises:
        SequenceError: a chosen pair is bad and `skip_bad` is not set, or none is left.
        ConfigError: a start time is given for a drive whose clock is UTC already.
    """

    def __init__(self, drive: ImageDrive, options: OpenOptions) -> None:
        self.info = with_options(drive.info, options)
        self.cameras = drive.cameras
        self.camera = drive.cameras.camera
        check_no_view(options, drive.cameras)
        self.frames = options.frames
        self._drive = drive
        self._options = options
        places = drive.places
        self._shift_ns = 0
        if options.recorded_at_ns is not None:
            places, self._shift_ns = _shifted(places, options.recorded_at_ns)
        self.motion()  # so that a file that cannot be used is known at once
        self._pairs, self._listing_faults = usable_pairs(
            places, options.skip_bad, drive.path, partial(_chosen, options)
        )
        self._check_sizes()
        self._mask = None if options.mask is None else read_mask(options.mask, drive.cameras)
        self._reading_faults: list[str] = []
        self.stamps = stamp_report(drive.places)
        telling = range(len(self._pairs))[TELLING]
        check_sides(drive.cameras, self.usable(telling), drive.path)

    @property
    def rectification(self) -> Rectification | None:
        """Rectification of raw images; None for a rectified drive."""
        return self.cameras.rectification

    def motion(self) -> MotionSource | None:
        """A new pass through the motion of the caller's files; None without one.

        Raises:
            SequenceError: a file cannot be used.
        """
        mounting = self.camera.cam_from_rig
        return motion_of_files(self._options.motion, mounting, self._shift_ns)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(N,) int64 stamps of the pairs, ns, including pairs that may prove unreadable."""
        return np.array([pair.stamp_ns for pair in self._pairs], dtype=np.int64)

    @property
    def skipped(self) -> int:
        """Pairs left out so far under `skip_bad`, in the latest pass; not those by their stamps."""
        return len(self.skipped_reasons)

    @property
    def skipped_reasons(self) -> list[str]:
        """Why each of the `skipped` pairs was left out."""
        bad = (one for one in self._listing_faults if not isinstance(one, WrongStamp))
        return [*bad, *self._reading_faults]

    @property
    def stamp_facts(self) -> list[str]:
        """Faults of the stamps of images and motion, for people; empty for sound ones."""
        return [*self.stamps.texts("pair"), *stamp_facts_of_files(self._options.motion)]

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[StereoPair]:
        """Decodes one pair at a time.

        Raises:
            SequenceError: an image is missing, unreadable or of the wrong size, and `skip_bad`
                is not set.
        """
        self._reading_faults.clear()
        return self.usable(range(len(self._pairs)))

    def usable(self, indices: Iterable[int]) -> Iterator[StereoPair]:
        """Decodes some pairs, as iterating decodes all.

        Raises:
            SequenceError: as for iterating.
        """
        for index in indices:
            try:
                pair = self.read(index)
            except SequenceError as error:
                if not self._options.skip_bad:
                    advice = self._advice(index)
                    raise SequenceError(f"{error}; {advice}") from error
                self._reading_faults.append(str(error))
                continue
            yield pair

    def _advice(self, bad: int) -> str:
        """What to do about a bad pair, by whether others are better."""
        for index in {0, len(self) // 2, len(self) - 1} - {bad}:
            with suppress(SequenceError):
                self.read(index)
                return "leave it out with --skip-bad"
        return "the pairs in the middle and at the end cannot be read either"

    def bits(self) -> int | None:
        """Bits of the brightest pixel of a few left images of 16 bits; None for 8-bit ones.

        Images that cannot be read are left out.
        """
        found: list[int] = []
        for index in {0, len(self) // 2, len(self) - 1}:
            with suppress(SequenceError):
                bits = image_bits(self._pairs[index].left)
                found += [] if bits is None else [bits]
        return max(found, default=None)

    def read(self, index: int) -> StereoPair:
        """Decode pair `index` of `len(self)`, whatever `skip_bad` says.

        Raises:
            SequenceError: as for iterating.
        """
        files = self._pairs[index]
        rectification = self.cameras.rectification
        left, right = self._load(files)
        if rectification is not None:
            left, right = rectified(left, rectification.left), rectified(right, rectification.right)
        return StereoPair(files.stamp_ns, left, right, self.camera, self._mask)

    def _check_sizes(self) -> None:
        """Refuses a calibration of another image size; one wrong image alone is a bad pair."""
        sizes = set()
        for pair in (self._pairs[0], self._pairs[-1]):
            with suppress(SequenceError):
                width, height = image_size(pair.left)
                sizes.add((width // 2, height) if pair.left == pair.right else (width, height))
        stated = self.camera.width, self.camera.height
        if len(sizes) != 1 or stated in sizes:
            return
        size = sizes.pop()
        raise SequenceError(
            f"{self._pairs[0].left}: the images are {size[0]}×{size[1]} px, the calibration says "
            f"{stated[0]}×{stated[1]}: give the calibration of these images"
            f"{scaled_by(stated, size)}"
        )

    def _load(self, files: PairFiles) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The two images, not rectified; rectification keeps their size."""
        width, height, channel = self.camera.width, self.camera.height, self._options.channel
        if files.left == files.right:
            both = self._drive.read(files.left, 2 * width, height, channel)
            return half(both, Side.LEFT), half(both, Side.RIGHT)
        left, right = (
            self._drive.read(path, width, height, channel) for path in (files.left, files.right)
        )
        return left, right


class Side(StrEnum):
    """A side of an image that holds both of a pair's, side by side."""

    LEFT = "left"
    RIGHT = "right"


def half(image: NDArray[np.uint8], side: Side) -> NDArray[np.uint8]:
    """The (h, w / 2) uint8 image of one side of a (h, w) image that holds both."""
    width = image.shape[1] // 2
    return np.ascontiguousarray(image[:, :width] if side is Side.LEFT else image[:, -width:])


def rectified(image: NDArray[np.uint8], table: RemapTable) -> NDArray[np.uint8]:
    """The (h, w) uint8 rectified image of a raw one of the same size."""
    return np.asarray(
        cv2.remap(image, table.pixels, table.fractions, cv2.INTER_LINEAR), dtype=np.uint8
    )


def with_options(info: SequenceInfo, options: OpenOptions) -> SequenceInfo:
    """Facts of a drive, completed by the caller's options.

    Raises:
        ConfigError: a start time is given for a drive whose clock is UTC already.
    """
    clock = info.clock
    if options.recorded_at_ns is not None:
        if clock is Clock.UTC:
            raise ConfigError(
                f"{info.name}: its stamps are UTC already; a start time is for drives whose clock "
                "is relative or unknown"
            )
        clock = Clock.UTC
    return replace(
        info,
        clock=clock,
        name=printable(info.name),
        robot=info.robot if options.robot is None else options.robot,
        longitude_deg=(
            info.longitude_deg if options.longitude_deg is None else options.longitude_deg
        ),
        zone=info.zone if options.zone is None else options.zone,
    )


def _chosen(options: OpenOptions, places: Listing) -> Listing:
    """The places of the chosen frames and times; a fault between two pairs stays."""
    chosen = options.frames.of(places)
    if options.times.is_all:
        return chosen
    first_ns = next((place.stamp_ns for place in places if isinstance(place, PairFiles)), 0)
    inside = [
        row
        for row, place in enumerate(chosen)
        if isinstance(place, PairFiles) and options.times.holds(place.stamp_ns, first_ns)
    ]
    return chosen[inside[0] : inside[-1] + 1] if inside else []


def _shifted(places: Listing, start_ns: int) -> tuple[Listing, int]:
    """The same places, shifted so that the first good stamp is `start_ns`; and the shift, ns."""
    first_ns = next((place.stamp_ns for place in places if isinstance(place, PairFiles)), 0)
    moved_ns = start_ns - first_ns
    return [
        place if isinstance(place, str) else replace(place, stamp_ns=place.stamp_ns + moved_ns)
        for place in places
    ], moved_ns
