"""A bag as a drive: its pairs by stamp, and what it holds."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import Cameras
from engram.calibration.formats import read_calibration
from engram.counts import counted
from engram.errors import CalibrationError, InputError, SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.graph.model import Clock
from engram.odometry.outside import MotionSource
from engram.sequences.bags.containers import Bag, DamageError, files_of
from engram.sequences.bags.fixes import FIX, Fix, fix_topics, fixes_of
from engram.sequences.bags.messages import (
    IMU,
    ODOMETRY,
    TWIST,
    BagMotion,
    Decoder,
    Stamps,
    clock_of,
    mounted,
    mounting,
    read_cameras,
    read_infos,
    read_transforms,
    with_constant,
)
from engram.sequences.bags.topics import (
    StereoTopics,
    depth_of,
    grey_of,
    only_topic,
    same_images,
    size_of,
    stereo_topics,
)
from engram.sequences.calibrating import TELLING, check_no_view, check_sides, read_mask
from engram.sequences.clocks import StampReport, SteadyClock, Timed, in_time, joined
from engram.sequences.layouts import YEAR_2000_NS, Side, half, rectified, with_options
from engram.sequences.listing import paired
from engram.sequences.motion_files import stamp_facts_of_files
from engram.sequences.sequence import OpenOptions, SequenceInfo

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
        received_ns: when the recorder received it, ns.
    """

    number: int
    stamp_ns: int
    received_ns: int
    content: T


@dataclass(slots=True)
class Pairing:
    """Outcome of pairing the images in a pass through the bag.

    Attributes:
        unusable: images that could not be decoded or do not fit.
        placed: left images that have a time, and so a right one or none.
        complete: whether the pass reached the end of the bag; if not, some images still waited.
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
    """
    timed = [
        in_time(shots, lambda shot: shot.stamp_ns, clock, lambda shot: shot.received_ns)
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


# Images from which the tolerance of pairs is learnt.
_LEARNT_FROM = 100
# Images of either side that tell how many of 16 bits the cameras use.
_BITS_FROM = 10
_MOST_REASONS = 20
_PLACE = re.compile(r": image \d+:? ")


def open_bag(path: Path, options: OpenOptions) -> BagSequence:
    """A bag as a drive; see `BagSequence`."""
    return BagSequence(path, options)


class BagSequence:
    """A `StereoSequence` over a ROS bag, read as a stream: memory does not grow with the bag.

    Images that cannot be decoded, or have no partner of their instant, are left out and counted;
    damaged parts of the file are reported in `lost`. A pair's stamp is its time by the rule of
    `engram.sequences.clocks`: that of the left image, unless the clock was set back before.

    Attributes:
        pairing: outcome of pairing the images, in the latest pass.
    """

    def __init__(self, path: Path, options: OpenOptions) -> None:
        self._options = options
        self._bag = Bag(path)
        self._decoder = Decoder(self._bag.is_ros1)
        self._stamps: dict[str, Stamps] = {}
        given = None if options.calibration is None else self._given(options)
        self.topics = self._stereo_topics(given)
        if given is not None and self.topics.are_rectified and given.rectification is not None:
            given = self._given(options, rectified=True)
        self._reasons: dict[str, list[str]] = {}
        tolerance_ns, self._first_ns = self._learn()
        self.pairing = Pairing(tolerance_ns)
        self._static = read_transforms(self._bag, self._decoder)
        transforms = with_constant(self._static, self._bag, self._decoder, self.frame)
        self.cameras = mounted(given or self._calibrated(options), mounting(transforms, self.frame))
        self.transforms = transforms
        self.camera: StereoCamera = self.cameras.camera
        check_no_view(options, self.cameras)
        self._mask = None if options.mask is None else read_mask(options.mask, self.cameras)
        self._shift_ns = (
            0 if options.recorded_at_ns is None else options.recorded_at_ns - self._first_ns
        )
        clock = Clock.UTC if self._first_ns >= YEAR_2000_NS else Clock.RELATIVE
        name = path.resolve().name.split(".")[0]
        self.info = with_options(SequenceInfo(name, "bag", clock), options)
        self._motion = BagMotion(
            self._bag,
            self._decoder,
            options.motion,
            transforms,
            self.camera.cam_from_rig,
        )
        self._fix_clocks: dict[str, SteadyClock] = {}
        self._bits = self._depth()
        if self.cameras.sides_doubtful:
            telling = islice(self, TELLING.start, TELLING.stop, TELLING.step)
            check_sides(self.cameras, telling, path)
            self.pairing = Pairing(tolerance_ns)
            self._reasons.clear()

    def motion(self) -> MotionSource | None:
        """A new pass through the motion by wheels or gyroscope; None without one."""
        return self._motion.source(self._shift_ns)

    def fixes(self) -> Iterator[Fix] | None:
        """A new pass through the fixes of its satellite receiver; None without exactly one."""
        names = fix_topics(self._bag)
        if len(names) != 1:
            return None
        clock = self._fix_clocks[names[0]] = SteadyClock(waits=True)
        fixes = fixes_of(self._bag, names[0], self._decoder, clock)
        return (replace(fix, time_ns=fix.time_ns + self._shift_ns) for fix in fixes)

    @property
    def frame(self) -> str:
        """Name of the left camera's frame, of its first image or `CameraInfo`; "" without one."""
        first = next(self._shots(self.topics.left), None)
        named = "" if first is None else _frame(first.content)
        if named:
            return named
        try:
            infos = read_infos(self._bag, self._decoder, self.topics)
        except CalibrationError:  # of a bag whose calibration is given
            return ""
        return "" if infos is None else infos[0].frame.lstrip("/")

    @property
    def frames(self) -> str:
        """Which of the left images are used."""
        return str(self._options.frames)

    @property
    def skipped(self) -> int:
        """Images left out so far, in the latest pass, as damaged or of another size."""
        return self.pairing.unusable

    @property
    def stamps(self) -> StampReport:
        """What happened to the stamps of its images, in the latest pass."""
        return self.pairing.stamps

    def read_stamps(self) -> StampReport:
        """Reads the stamps of all images, without decoding them."""
        self.pairing = Pairing(self.pairing.tolerance_ns)
        for _ in pairs_of(self._met(Side.LEFT), self._met(Side.RIGHT), self.pairing):
            pass
        return self.stamps

    @property
    def stamp_facts(self) -> list[str]:
        """Faults of the stamps of images, motion and fixes, for people."""
        left, right = (clock.report for clock in self.pairing.clocks)
        reports = {"left image": left}
        if right != left:
            reports["right image"] = right
        for topic, clock in {**self._motion.clocks, **self._fix_clocks}.items():
            reports[f"message of {topic}"] = clock.report
        named = self._motion.files
        facts = [fact for what, report in reports.items() for fact in report.texts(what)]
        return facts + stamp_facts_of_files(named)

    @property
    def skipped_reasons(self) -> list[str]:
        """Why, once for each reason, with the number of images."""
        return [_summed(faults) for faults in self._reasons.values()]

    @property
    def lost(self) -> list[str]:
        """The unreadable parts of the bag, in all passes; empty for a sound one."""
        return [*self._bag.lost, *self.skipped_reasons]

    @property
    def notes(self) -> list[str]:
        """The entries of calibration and mounting that were not read as they are written."""
        notes, frame = list(self.cameras.notes), self.frame
        base, moving = self.transforms.base_of(frame), self.transforms.turning(frame)
        if self.camera.cam_from_rig is None and moving is not None:
            notes.append(
                f"the mounting is unknown: /tf moves {moving} during the drive, and with it the "
                "camera; hold it still, or state cam_from_rig in a --calibration FILE"
            )
        elif base is not None and self._static.base_of(frame) is None:
            notes.append(f"the mounting on {base} is that of /tf, which is constant there")
        return notes

    def __len__(self) -> int:
        """Number of pairs, at most: how many are of one instant is known after reading."""
        counts = [self._bag.topics[name].count for name in (self.topics.left, self.topics.right)]
        if None in counts:
            counts = [sum(1 for _ in self._bag.records({self.topics.left}))]
        return len(self._options.frames.indices(min(count or 0 for count in counts)))

    def __iter__(self) -> Iterator[StereoPair]:
        """Decodes one pair at a time."""
        self.pairing = Pairing(self.pairing.tolerance_ns)
        self._reasons.clear()
        frames, times, used = self._options.frames, self._options.times, 0
        sides = (self._met(Side.LEFT), self._met(Side.RIGHT))
        for left, right in pairs_of(*sides, self.pairing):
            number = left.item.number
            if frames.stop is not None and number >= frames.stop:
                break
            if times.is_after(left.time_ns, self._first_ns):
                break
            if right is None or number not in frames.indices(number + 1):
                continue
            if times.is_before(left.time_ns, self._first_ns):
                continue
            pair = self._decoded(left.time_ns, left.item, right)
            if pair is not None:
                used += 1
                yield pair
        if not used:
            why = f"; {self.skipped_reasons[0]}" if self._reasons else ""
            raise SequenceError(
                f"{self._bag.path}: no usable pair among {self.pairing.left} left and "
                f"{self.pairing.right} right images{why}"
            )

    def _decoded(self, time_ns: int, left: Shot[Any], right: Shot[Any]) -> StereoPair | None:
        """The pair; None if an image of it is damaged or does not fit."""
        table = self.cameras.rectification
        try:
            image = self._image(self.topics.left, left, Side.LEFT, table and table.left)
            other = self._image(self.topics.right, right, Side.RIGHT, table and table.right)
        except SequenceError as error:
            self.pairing.paired -= 1
            self._unusable(str(error))
            return None
        return StereoPair(time_ns + self._shift_ns, image, other, self.camera, self._mask)

    def _unusable(self, reason: str) -> None:
        self.pairing.unusable += 1
        place = _PLACE.sub(": ", reason, count=1)
        if place in self._reasons or len(self._reasons) < _MOST_REASONS:
            self._reasons.setdefault(place, []).append(reason)

    def _image(self, topic: str, shot: Shot[Any], side: Side, table: Any) -> NDArray[np.uint8]:
        where = f"{topic}: image {shot.number}"
        halves = self.topics.are_halves
        size = (self.camera.width * (1 + halves), self.camera.height)
        image = grey_of(shot.content, where, size, self._options.channel, self._bits)
        if halves:
            image = half(image, side)
        return image if table is None else rectified(image, table)

    def _shots(
        self, topic: str, damaged: Callable[[str], None] = lambda _: None
    ) -> Iterator[Shot[Any]]:
        kind = self._bag.topics[topic].type
        if topic not in self._stamps:
            self._stamps[topic] = Stamps(self._bag, self._decoder, topic)
        stamps = self._stamps[topic]
        for number, record in enumerate(self._bag.records({topic})):
            try:
                message = self._decoder.message(record, kind)
            except DamageError as error:
                damaged(f"{topic}: image {number} {error}")
            else:
                stamp_ns = stamps.of(message, record)
                yield Shot(number, stamp_ns, record.received_ns, message)

    def _met(self, side: Side) -> Iterator[Shot[Any]]:
        """The images of a side, as they are counted in this pass."""
        topic = self.topics.left if side is Side.LEFT else self.topics.right

        def damaged(reason: str) -> None:
            setattr(self.pairing, side, getattr(self.pairing, side) + 1)
            self._unusable(reason)

        for shot in self._shots(topic, damaged):
            setattr(self.pairing, side, getattr(self.pairing, side) + 1)
            yield shot

    def _learn(self) -> tuple[int, int]:
        """Tolerance of pairs and first time of the left images, ns."""
        stamps, first_ns = [], 0
        for topic in (self.topics.right, self.topics.left):
            why: list[str] = []
            shots = islice(self._shots(topic, why.append), _LEARNT_FROM)
            timed = list(in_time(shots, lambda shot: shot.stamp_ns, SteadyClock(waits=True)))
            if not timed:
                lost = "".join(f"; {fault}" for fault in self._bag.lost[:1])
                fault = why[0] if why else f"{topic}: no image can be read"
                raise SequenceError(f"{self._bag.path}: {fault}{lost}")
            stamps.append([shot.stamp_ns for shot in timed])
            first_ns = timed[0].time_ns
        try:
            most_ns = self._options.pair_tolerance_ns
            tolerance_ns = learnt_tolerance(stamps[1], stamps[0], most_ns)
        except SequenceError as error:
            raise SequenceError(f"{self._bag.path}: {self.topics}: {error}") from error
        return tolerance_ns, first_ns

    def _depth(self) -> int:
        """Bits that the cameras use of 16-bit images, by the first ones of both."""
        return max(
            depth_of(
                (shot.content for shot in islice(self._shots(topic), _BITS_FROM)),
                topic,
            )
            for topic in (self.topics.left, self.topics.right)
        )

    def _stereo_topics(self, given: Cameras | None) -> StereoTopics:
        left, right = self._options.left, self._options.right
        stated = given.topics if given is not None else None
        alone = left is None and right is None
        if alone and stated:
            there = [same_images(name, self._bag.topics) for name in stated]
            if None not in there:
                left, right = there
                alone = False
        try:
            raw = given is not None and given.rectification is not None
            topics = stereo_topics(self._bag.topics, left, right, prefer_raw=raw)
        except SequenceError as error:
            only = only_topic(self._bag.topics) if alone else None
            size = (0, 0) if only is None else self._first_size(only)
            if only is not None and given is not None and _are_two(size, given.camera):
                return StereoTopics(only, only)
            advice = "" if size[0] < 2 * size[1] or only is None else _as_halves(only, size)
            raise SequenceError(f"{self._bag.path}: {error}{advice}") from error
        if alone and given is not None and given.right_first and topics.are_numbered:
            return topics.exchanged()  # cam0 is the calibration's cam0
        return topics

    def _given(self, options: OpenOptions, *, rectified: bool = False) -> Cameras:
        assert options.calibration is not None
        given = read_calibration(
            options.calibration,
            rectified=rectified,
            size=self._size,
            field_of_view_deg=options.field_of_view_deg,
        )
        if rectified and given.rectification is not None:
            raise CalibrationError(
                f"{self._bag.path}: {options.calibration} describes raw images, but {self.topics} "
                "are rectified: name the raw topics with --left and --right"
            )
        return given

    def _calibrated(self, options: OpenOptions) -> Cameras:
        view = options.field_of_view_deg
        return read_cameras(self._bag, self._decoder, self.topics, self._size(), view)

    def _size(self) -> tuple[int, int]:
        topics = self._stereo_topics(None)
        width, height = self._first_size(topics.left)
        return (width // 2, height) if topics.are_halves else (width, height)

    def _first_size(self, left: str) -> tuple[int, int]:
        why: list[str] = []
        for shot in islice(self._shots(left, why.append), _LEARNT_FROM):
            try:
                return size_of(shot.content, left)
            except SequenceError as error:
                why.append(str(error))
        fault = why[-1] if why else f"{left}: no image can be read"
        raise SequenceError(f"{self._bag.path}: {fault}")


def _are_two(size: tuple[int, int], camera: StereoCamera) -> bool:
    """Whether an image of this size holds two of a camera's side by side."""
    return size == (2 * camera.width, camera.height)


def _as_halves(topic: str, size: tuple[int, int]) -> str:
    """How a topic of wide images is read, if they hold both sides."""
    return (
        f"\nif each image holds left and right side by side, {size[0] // 2}×{size[1]} px each, "
        f"name the topic twice: --left {topic} --right {topic} --calibration FILE, which is the "
        "calibration of the halves"
    )


def _summed(faults: list[str]) -> str:
    """One reason for which images were left out, and how many they were."""
    more = len(faults) - 1
    return faults[0] if not more else f"{faults[0]} (and {counted(more, 'image')} more)"


def _frame(message: Any) -> str:
    return str(message.header.frame_id).lstrip("/")


# A gap is this much longer than the usual interval.
_GAP_RATIO = 3.0


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """One topic.

    Attributes:
        rate_hz: usual rate; 0 for fewer than two messages.
        gaps: intervals of more than three times the usual one.
        longest_gap_s: the longest of them; 0 if there is none.
    """

    name: str
    type: str
    messages: int
    rate_hz: float
    size_bytes: int
    gaps: int
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class BagFacts:
    """What a bag holds.

    Attributes:
        transforms: static transforms, "parent → child".
        left, right: image topics of the stereo pair; None if they are not found.
        question: why the pair or its calibration is not found; "" if it is.
        calibration: what was found of the pair's calibration, in a line.
        mounting: frame of the robot that the camera's mounting refers to, or "calibration" if
            the given one states it; None if unknown.
        notes: what was read otherwise than it is written.
        stamps: what is wrong with the stamps of images, motion and fixes, for people.
        faulty_share: share of the left images that are left out for a wrong stamp.
    """

    path: str
    files: int
    size_bytes: int
    start_ns: int
    duration_s: float
    topics: list[TopicFacts]
    transforms: list[str]
    left: str | None
    right: str | None
    question: str
    calibration: str
    mounting: str | None
    command: str
    notes: list[str]
    lost: list[str]
    stamps: list[str]
    faulty_share: float


def describe_bag(path: Path, options: OpenOptions | None = None) -> BagFacts:
    """Reads a bag's topics, calibration and transforms."""
    options = options or OpenOptions()
    bag = Bag(path)
    topics, start_ns, end_ns = _topics(bag)
    static = read_transforms(bag, Decoder(bag.is_ros1))
    drive, question = _opened(path, options)
    left = None if drive is None else drive.topics.left
    return BagFacts(
        str(path),
        len(files_of(path)),
        bag.size_bytes,
        start_ns,
        (end_ns - start_ns) / 1e9,
        topics,
        [f"{parent} → {child}" for child, (parent, _) in sorted(static.parents.items())],
        left,
        None if drive is None else drive.topics.right,
        question,
        "" if drive is None else _calibration(drive),
        _mounting(drive),
        _command(path, options, topics, drive, question),
        [] if drive is None else drive.notes,
        bag.lost,
        *_stamps(bag, drive),
    )


def _topics(bag: Bag) -> tuple[list[TopicFacts], int, int]:
    stamps: dict[str, list[int]] = {name: [] for name in bag.topics}
    sizes = dict.fromkeys(bag.topics, 0)
    for record in bag.records():
        if record.topic in stamps:
            stamps[record.topic].append(record.received_ns)
            sizes[record.topic] += len(record.data)
    facts = []
    for name, found in sorted(stamps.items()):
        intervals_ns = np.array([after - before for before, after in pairwise(sorted(found))])
        usual_ns = float(np.median(intervals_ns)) if len(intervals_ns) else 0.0
        gaps_ns = [
            interval_ns
            for interval_ns in intervals_ns.tolist()
            if interval_ns > _GAP_RATIO * max(usual_ns, 1.0)
        ]
        facts.append(
            TopicFacts(
                name,
                bag.topics[name].type,
                len(found),
                1e9 / usual_ns if usual_ns else 0.0,
                sizes[name],
                len(gaps_ns),
                max(gaps_ns, default=0) / 1e9,
            )
        )
    every = [stamp for found in stamps.values() for stamp in found]
    return facts, min(every, default=0), max(every, default=0)


def _stamps(bag: Bag, drive: BagSequence | None) -> tuple[list[str], float]:
    """Faults of stamps, for people, and the share of images left out because of them."""
    facts, share = [], 0.0
    if drive is not None:
        share = drive.read_stamps().faulty_share
        facts += drive.stamp_facts
    decoder = Decoder(bag.is_ros1)
    for topic in sorted(bag.topics.values(), key=lambda topic: topic.name):
        if topic.type in {ODOMETRY, TWIST, IMU, FIX}:
            facts += clock_of(bag, decoder, topic.name).report.texts(f"message of {topic.name}")
    return facts, share


def _opened(path: Path, options: OpenOptions) -> tuple[BagSequence | None, str]:
    """The drive; or why the bag is not one yet."""
    try:
        return BagSequence(path, options), ""
    except InputError as error:
        return None, str(error).removeprefix(f"{path}: ")


def _calibration(drive: BagSequence) -> str:
    camera, raw = drive.camera, drive.cameras.raw
    images = "rectified images" if raw is None else f"raw images, {raw.left.distortion} lenses"
    return (
        f"{camera.width}×{camera.height} px, fx {camera.fx:.1f} px, baseline "
        f"{camera.baseline_m:.4f} m; {images}"
    )


def _mounting(drive: BagSequence | None) -> str | None:
    if drive is None or drive.camera.cam_from_rig is None:
        return None
    return drive.transforms.base_of(drive.frame) or "calibration"


def _command(
    path: Path,
    options: OpenOptions,
    topics: list[TopicFacts],
    drive: BagSequence | None,
    question: str,
) -> str:
    """`engram map` with every option that this bag needs; what is to be filled in is in capitals.

    Empty if no option helps.
    """
    asks = any(words in question for words in ("name them", "choose one", "name the topic twice"))
    if drive is None and not asks and "--calibration FILE" not in question:
        return ""
    motion = [
        topic.name for topic in topics if topic.type in {ODOMETRY, TWIST, IMU} and topic.messages
    ]
    words = ["engram", "map", "MAP.engram", str(path)]
    for option, value in (("--left", options.left), ("--right", options.right)):
        words += [option, value] if value else []
    if drive is None and asks:
        given = re.search(r"--left (\S+) --right (\S+)", question)
        left, right = ("LEFT", "RIGHT") if given is None else given.groups()
        words += ["--left", left, "--right", right]
    if options.calibration is not None:
        words += ["--calibration", str(options.calibration)]
    elif drive is None and "--calibration FILE" in question:
        words += ["--calibration", "FILE"]
    for name in motion:
        words += ["--motion", name]
    return shlex.join(words)
