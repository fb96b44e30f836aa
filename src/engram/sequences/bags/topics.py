"""Finds the two image topics of a stereo pair by the names that drivers give them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from engram.errors import SequenceError
from engram.sequences.bags.pictures import COMPRESSED, IMAGE
from engram.sequences.bags.records import Topic

# How drivers tell left from right.
_SIDES = (
    ("left", "right"),
    ("Left", "Right"),
    ("port", "starboard"),
    ("infra1", "infra2"),
    ("infra_1", "infra_2"),
    ("cam0", "cam1"),
    ("cam_0", "cam_1"),
    ("camera0", "camera1"),
    ("camera_0", "camera_1"),
    ("camera1", "camera2"),
)
# Images of something else than light.
_NOT_PICTURES = re.compile(r"depth|disparity|confidence|mask|label|segment|overlay", re.IGNORECASE)
# Of one camera's topics the first that exists: rectified before raw, grey before colour, whole
# before compressed. Names as of image_pipeline, ZED and RealSense.
_PREFERRED = (
    r"image_rect$",
    r"image_rect_(gray|grey|mono)$",
    r"image_rect_(color|colour)$",
    r"image_rect_raw$",
    r"rect(ified)?/image\w*$|image_rectified\w*$",
    r"image_mono$",
    r"image_raw$",
    r"image(_color|_raw_color|_gray)?$",
)
_COMPRESSED = "/compressed"
_MOST_SHOWN = 12


@dataclass(frozen=True, slots=True)
class StereoTopics:
    """The image topics of a pair."""

    left: str
    right: str

    @property
    def are_rectified(self) -> bool:
        """Whether their names say that the images are rectified."""
        return "rect" in self.left.lower()

    def __str__(self) -> str:
        return f"--left {self.left} --right {self.right}"


def image_topics(topics: Mapping[str, Topic]) -> list[str]:
    """Names of the topics with images, empty ones left out."""
    return sorted(
        name
        for name, topic in topics.items()
        if topic.type in {IMAGE, COMPRESSED} and topic.count != 0
    )


def stereo_topics(
    topics: Mapping[str, Topic],
    left: str | None = None,
    right: str | None = None,
    *,
    prefer_raw: bool = False,
) -> StereoTopics:
    """The image topics of a bag's stereo pair.

    Args:
        topics: all topics.
        left, right: what the caller named; None finds it.
        prefer_raw: whether of one camera's topics the raw one is wanted, which the caller's
            calibration describes.

    Raises:
        SequenceError: a named topic has no images, or there is no pair, or more than one.
    """
    images = image_topics(topics)
    for option, name in (("--left", left), ("--right", right)):
        if name is not None and name not in images:
            raise SequenceError(f"{option} {name}: {_what_is_there(topics, name)}\n{_list(images)}")
    if left is not None and right is not None:
        if left == right:
            raise SequenceError(f"--left and --right both name {left}: a pair has two topics")
        return StereoTopics(left, right)
    pairs = [
        pair for pair in _pairs(images) if left in {None, pair.left} and right in {None, pair.right}
    ]
    best = _best_of_each_rig(pairs, prefer_raw) if left is None and right is None else pairs
    if len(best) == 1:
        return best[0]
    if best:
        choices = "\n".join(f"  {pair}" for pair in best)
        raise SequenceError(f"the bag has {len(best)} stereo pairs; choose one with\n{choices}")
    raise SequenceError(f"{_no_pair(images)}\n{_list(images)}")


def _no_pair(images: Collection[str]) -> str:
    """Why there is no pair, and what to do."""
    pictures = [name for name in images if not _NOT_PICTURES.search(name)]
    if len(pictures) < 2:
        return "the images of one camera only, and Engram needs both of a stereo camera"
    if len(pictures) == 2:
        return (
            "no pair of image topics is named left and right; if these two are a stereo camera, "
            f"name them: --left {pictures[0]} --right {pictures[1]}"
        )
    return (
        "no pair of image topics is named left and right (or infra1 and infra2, cam0 and cam1); "
        "name them with --left TOPIC --right TOPIC"
    )


def _pairs(images: Collection[str]) -> Iterator[StereoTopics]:
    for name in images:
        if _NOT_PICTURES.search(name):
            continue
        for left, right in _SIDES:
            partner = name.replace(left, right)
            if left in name and partner in images:
                yield StereoTopics(name, partner)
                break


def _best_of_each_rig(pairs: Collection[StereoTopics], prefer_raw: bool) -> list[StereoTopics]:
    """One pair of topics for each rig: the part of the name before the camera's word tells rigs."""
    rigs: dict[str, StereoTopics] = {}
    for pair in sorted(pairs, key=lambda pair: (_rank(pair, prefer_raw), pair.left)):
        place = next(pair.left.index(word) for word, _ in _SIDES if word in pair.left)
        rigs.setdefault(pair.left[:place], pair)
    return sorted(rigs.values(), key=lambda pair: pair.left)


def _rank(pair: StereoTopics, prefer_raw: bool) -> tuple[bool, int, bool]:
    bare = pair.left.removesuffix(_COMPRESSED)
    order = [re.search(pattern, bare) is not None for pattern in _PREFERRED]
    place = order.index(True) if any(order) else len(order)
    return prefer_raw and pair.are_rectified, place, bare != pair.left


def info_topic(image: str, topics: Mapping[str, Topic]) -> str | None:
    """The `camera_info` topic of an image topic: beside it, or the nearest above; None if none."""
    parts = image.split("/")
    for length in range(len(parts) - 1, 0, -1):
        name = "/".join([*parts[:length], "camera_info"])
        if name in topics:
            return name
    return None


def _what_is_there(topics: Mapping[str, Topic], name: str) -> str:
    if name not in topics:
        return "the bag has no such topic"
    topic = topics[name]
    return "holds no message" if topic.count == 0 else f"holds {topic.type}, not images"


def _list(images: Collection[str]) -> str:
    if not images:
        return "the bag has no topic with images (sensor_msgs Image or CompressedImage)"
    more = len(images) - _MOST_SHOWN
    lines = ["its image topics are", *(f"  {name}" for name in list(images)[:_MOST_SHOWN])]
    return "\n".join([*lines, f"  and {more} more"] if more > 0 else lines)
