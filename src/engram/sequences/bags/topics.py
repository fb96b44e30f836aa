"""Finds the two image topics of a stereo pair by the names that drivers give them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

from engram.errors import SequenceError
from engram.sequences.bags.pictures import COMPRESSED, IMAGE
from engram.sequences.bags.records import Topic

# How drivers tell left from right, in small letters: words; letters that stand alone; and numbers
# behind a word for a camera. RealSense, ZED, OAK, Basler, FLIR, T265 and image_pipeline are among
# them.
_WORDS = (("left", "right"), ("port", "starboard"))
_LETTERS = (("l", "r"),)
_CAMERAS = r"(?:cam|camera|infra|infrared|fisheye|image|imager|mono|grey|gray)[_-]?0*"
_NUMBERS = (("0", "1"), ("1", "2"))
# What stands before the word of the left camera, that word, and the word of the right one.
_PATTERNS = tuple(
    (re.compile(f"({before})({left}){after}", re.IGNORECASE), right)
    for before, sides, after in (
        ("", _WORDS, ""),
        ("[/_.-]", _LETTERS, "(?=[/_.-]|$)"),
        (_CAMERAS, _NUMBERS, r"(?!\d)"),
    )
    for left, right in sides
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
_NESTED = ["info", "camera_info"]  # of RealSense's own recorder
_RECTIFIED = re.compile(r"(?<!un)(?<!un_)(?<!di)(?<!cor)rect(?!ang)")
_VIDEO = ("/FFMPEGPacket", "/CompressedVideo", "/theora_image_transport/msg/Packet")
_MOST_SHOWN = 12


@dataclass(frozen=True, slots=True)
class StereoTopics:
    """The image topics of a pair."""

    left: str
    right: str

    @property
    def are_rectified(self) -> bool:
        """Whether their names say that the images are rectified."""
        return _RECTIFIED.search(self.left.lower()) is not None

    @property
    def are_halves(self) -> bool:
        """Whether each image holds both sides, the left one in its left half."""
        return self.left == self.right

    @property
    def are_numbered(self) -> bool:
        """Whether only numbers distinguish the cameras, so that either may be the left one."""
        return re.sub(r"\d", "", self.left) == re.sub(r"\d", "", self.right)

    def exchanged(self) -> StereoTopics:
        """The same topics, exchanged."""
        return StereoTopics(self.right, self.left)

    def __str__(self) -> str:
        return f"--left {self.left} --right {self.right}"


def image_topics(topics: Mapping[str, Topic]) -> list[str]:
    """Names of the topics with images, empty ones left out."""
    return sorted(
        name
        for name, topic in topics.items()
        if topic.type in {IMAGE, COMPRESSED} and topic.count != 0
    )


def same_images(name: str, topics: Mapping[str, Topic]) -> str | None:
    """The topic of these images, as compressed or not as the bag has them; None if it has not."""
    bare = "/" + name.strip("/").removesuffix(_COMPRESSED)
    return next((one for one in (name, bare, bare + _COMPRESSED) if one in topics), None)


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
        left, right: what the caller named; None finds it. One topic named twice has both sides in
            each image.
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
    raise SequenceError(f"{_no_pair(images)}{_videos(topics)}\n{_list(images)}")


def only_topic(topics: Mapping[str, Topic]) -> str | None:
    """The topic with a camera's images if the bag has one alone; they may hold both sides."""
    pictures = [name for name in image_topics(topics) if not _NOT_PICTURES.search(name)]
    bare = {name.removesuffix(_COMPRESSED) for name in pictures}
    return pictures[0] if len(bare) == 1 else None


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


def _videos(topics: Mapping[str, Topic]) -> str:
    """Topics whose images are parts of a video, which is not read."""
    names = [name for name, topic in topics.items() if topic.type.endswith(_VIDEO)]
    if not names:
        return ""
    return (
        f"; {', '.join(names[:4])} hold video, which is not read: play the bag through "
        "image_transport's republish, and record the images"
    )


def _pairs(images: Collection[str]) -> Iterator[StereoTopics]:
    for name in images:
        if _NOT_PICTURES.search(name):
            continue
        for partner in partners(name):
            if partner in images:
                yield StereoTopics(name, partner)
                break


def partners(name: str) -> Iterator[str]:
    """The names that the right camera's topic may have, given that of the left camera."""
    for pattern, right in _PATTERNS:
        found = list(pattern.finditer(name))
        if found:
            yield pattern.sub(partial(_exchanged, right), name)
        for one in found if len(found) > 1 else ():  # as /left_arm/camera/left/image
            yield name[: one.start()] + _exchanged(right, one) + name[one.end() :]


def _place(name: str) -> int:
    """Where the word for the side stands."""
    return next(found.start(2) for pattern, _ in _PATTERNS if (found := pattern.search(name)))


def _exchanged(right: str, found: re.Match[str]) -> str:
    """The right camera's word for the left one's, in its case."""
    before, left = found.groups()
    if left.isupper():
        return before + right.upper()
    return before + (right.capitalize() if left[:1].isupper() else right)


def _best_of_each_rig(pairs: Collection[StereoTopics], prefer_raw: bool) -> list[StereoTopics]:
    """One pair of topics for each rig: the part of the name before the camera's word is the rig."""
    rigs: dict[str, StereoTopics] = {}
    for pair in sorted(pairs, key=lambda pair: (_rank(pair, prefer_raw), pair.left)):
        rigs.setdefault(pair.left[: _place(pair.left)], pair)
    return sorted(rigs.values(), key=lambda pair: pair.left)


def _rank(pair: StereoTopics, prefer_raw: bool) -> tuple[bool, int, bool]:
    bare = pair.left.removesuffix(_COMPRESSED)
    order = [re.search(pattern, bare) is not None for pattern in _PREFERRED]
    place = order.index(True) if any(order) else len(order)
    return prefer_raw and pair.are_rectified, place, bare != pair.left


def info_topics(stereo: StereoTopics, infos: Collection[str]) -> StereoTopics | None:
    """The `camera_info` topics of a pair; None if the bag has not one for each camera.

    They are next to the images or above them, are named as the images are, or are the only two.

    Args:
        stereo: the image topics.
        infos: the topics with `CameraInfo`.
    """
    beside = [_info_beside(image, infos) for image in (stereo.left, stereo.right)]
    if None not in beside and beside[0] != beside[1]:
        return StereoTopics(str(beside[0]), str(beside[1]))
    pairs = list(_pairs(infos))
    if list(_pairs([stereo.left, stereo.right])) == [stereo.exchanged()]:
        pairs = [one.exchanged() for one in pairs]
    return max(pairs, key=lambda one: _shared(one.left, stereo.left), default=None)


def _shared(one: str, other: str) -> int:
    """Number of letters that two names begin with alike."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((at for at, (a, b) in pairs if a != b), min(len(one), len(other)))


def _info_beside(image: str, infos: Collection[str]) -> str | None:
    """The topic next to an image topic or inside it, or the nearest above."""
    parts = image.removesuffix(_COMPRESSED).split("/")
    names = [f"{'/'.join(parts)}_camera_info", f"{'/'.join(parts)}_info"]
    for length in range(len(parts), 0, -1):
        names += ["/".join([*parts[:length], *end]) for end in (["camera_info"], _NESTED)]
    return next((name for name in names if name in infos), None)


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
