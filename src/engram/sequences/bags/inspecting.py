"""What a bag holds, read once from front to back, without decoding images."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from engram.errors import InputError
from engram.sequences.bags.bag import Bag, files_of
from engram.sequences.bags.calibrating import read_transforms
from engram.sequences.bags.fixes import FIX
from engram.sequences.bags.messages import Decoder, clock_of
from engram.sequences.bags.motion import IMU, ODOMETRY, TWIST
from engram.sequences.bags.sequence import BagSequence
from engram.sequences.options import OpenOptions

# A gap is this much longer than the usual interval.
_GAP_RATIO = 3.0


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """One topic.

    Attributes:
        name, type: of the topic.
        messages: how many it has.
        rate_hz: usual rate; 0 for fewer than two messages.
        size_bytes: of all its messages.
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
        path: as given.
        files: number of files.
        size_bytes: of the files.
        start_ns: when the first message was recorded.
        duration_s: from the first to the last message.
        topics: by name.
        transforms: static transforms, "parent → child".
        left, right: image topics of the stereo pair; None if they are not found.
        question: why the pair or its calibration is not found; "" if it is.
        calibration: what was found of the pair's calibration, in a line.
        mounting: frame of the robot that the camera's mounting refers to, or "calibration" if
            the given one states it; None if unknown.
        command: the command that maps the bag.
        notes: what was read otherwise than it is written.
        lost: what could not be read.
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
    """Reads a bag's topics, calibration and transforms.

    Args:
        path: file or folder.
        options: how it would be opened.

    Raises:
        SequenceError: it cannot be read.
        MissingExtraError: the extra `bags` is not installed.
    """
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
    """Facts of all topics; stamps of the first and the last message, ns."""
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
        gaps_ns = [one for one in intervals_ns.tolist() if one > _GAP_RATIO * max(usual_ns, 1.0)]
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
    for topic in sorted(bag.topics.values(), key=lambda one: one.name):
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
