"""The image topics of a bag, and their messages as grey images."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import SequenceError
from engram.sequences.bags.containers import Topic
from engram.sequences.images import check_not_huge, decoded, grey
from engram.sequences.sequence import Channel

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

Pixels = NDArray[Any]


def _as_it_is(image: Pixels) -> Pixels:
    return image


def _bayer(code: int) -> Callable[[Pixels], Pixels]:
    return lambda image: cv2.cvtColor(image, code)


def _luma(first: int) -> Callable[[Pixels], Pixels]:
    return lambda image: image[:, :, first]


# Planar YUV: the first plane is the grey image. Rows of colour that follow, per row of the image.
_CHROMA_ROWS: Mapping[str, float] = MappingProxyType(
    {
        **dict.fromkeys(("nv12", "nv21", "i420", "iyuv", "yv12", "yuv420", "yuv420p"), 0.5),
        **dict.fromkeys(("nv16", "nv61", "yuv422p"), 1.0),
        **dict.fromkeys(("nv24", "nv42", "yuv444p"), 2.0),
    }
)

# Encoding → type of a value, values per pixel, and how OpenCV's grey or BGR follows.
# Source: sensor_msgs/image_encodings.hpp.
_ENCODINGS: Mapping[str, tuple[str, int, Callable[[Pixels], Pixels]]] = MappingProxyType(
    {
        **dict.fromkeys(("mono8", "8uc1", "y8", "grey8", "gray8"), ("u1", 1, _as_it_is)),
        **dict.fromkeys(("mono16", "16uc1", "y16", "y10", "y12"), ("u2", 1, _as_it_is)),
        **dict.fromkeys(("mono10", "mono12", "mono14"), ("u2", 1, _as_it_is)),
        **dict.fromkeys(("bgr8", "8uc3"), ("u1", 3, _as_it_is)),
        **dict.fromkeys(("bgra8", "8uc4"), ("u1", 4, _as_it_is)),
        "rgb8": ("u1", 3, lambda image: image[:, :, ::-1]),
        "rgba8": ("u1", 4, lambda image: image[:, :, [2, 1, 0, 3]]),
        "bgr16": ("u2", 3, _as_it_is),
        "rgb16": ("u2", 3, lambda image: image[:, :, ::-1]),
        **{name: ("u1", 2, _luma(1)) for name in ("yuv422", "uyvy")},
        **{name: ("u1", 2, _luma(0)) for name in ("yuv422_yuy2", "yuyv", "yuy2", "yvyu")},
        **dict.fromkeys(_CHROMA_ROWS, ("u1", 1, _as_it_is)),
        **{
            f"bayer_{ours}{bits}": (f"u{bits // 8}", 1, _bayer(code))
            for bits in (8, 16)
            for ours, code in (
                ("rggb", cv2.COLOR_BayerRGGB2BGR),
                ("bggr", cv2.COLOR_BayerBGGR2BGR),
                ("gbrg", cv2.COLOR_BayerGBRG2BGR),
                ("grbg", cv2.COLOR_BayerGRBG2BGR),
            )
        },
    }
)


# Bits that cameras store in 16.
_DEPTHS = (8, 10, 12, 14, 16)


def grey_of(
    message: Any,
    where: str,
    size: tuple[int, int] | None = None,
    channel: Channel = Channel.GREY,
    bits: int = 16,
) -> NDArray[np.uint8]:
    """The (h, w) uint8 grey image of a message.

    Args:
        message: `sensor_msgs/Image` or `CompressedImage`.
        size: required width and height, px; None for any.
        bits: that are used of 16-bit images; brighter pixels are white.
    """
    image = _pixels(message, where, size)
    if bits < 16 and image.dtype == np.uint16:
        image = np.minimum(image, (1 << bits) - 1) << (16 - bits)
    return grey(where, image, channel)


def depth_of(messages: Iterable[Any], where: str) -> int:
    """Bits that the brightest pixel of 16-bit images needs, as cameras store them; else 16.

    Images of which the first has 8 bits, or that cannot be decoded, are not looked at.
    """
    brightest = 0
    for message in messages:
        try:
            image = _pixels(message, where, None)
        except SequenceError:
            continue
        if image.dtype != np.uint16:
            break
        brightest = max(brightest, int(image.max(initial=0)))
    if not brightest:
        return _DEPTHS[-1]
    return next(depth for depth in _DEPTHS if brightest < 1 << depth)


def size_of(message: Any, where: str) -> tuple[int, int]:
    """Width and height of an image message, px."""
    if hasattr(message, "format"):
        height, width = decoded(where, bytes(message.data)).shape[:2]
        return width, height
    return int(message.width), _rows_of(message)[0]


def _rows_of(message: Any) -> tuple[int, int]:
    """Number of rows of a raw image, and bytes from one to the next.

    Of planar YUV some drivers state all bytes of a pixel in the step, or the rows of the colours in
    the height.
    """
    width, height, step = int(message.width), int(message.height), int(message.step)
    whole = 1 + _CHROMA_ROWS.get(str(message.encoding).strip().lower(), 0.0)
    if whole == 1:
        return height, step
    step = width if step == round(whole * width) else step
    all_rows = len(message.data) < step * height * whole
    return (round(height / whole) if all_rows else height), step


def _pixels(message: Any, where: str, size: tuple[int, int] | None) -> Pixels:
    """The grey, BGR or BGRA image of a message, of 8 or 16 bits."""
    if hasattr(message, "format"):
        image: Pixels = decoded(where, bytes(message.data), size)
        encoding = str(message.format).split(";")[0].strip().lower()
        if encoding.startswith("bayer_") and encoding in _ENCODINGS and image.ndim == 2:
            image = _ENCODINGS[encoding][2](image)
        return image
    encoding = str(message.encoding).strip().lower()
    if encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise SequenceError(
            f"{where}: encoding is {encoding[:40]!r}; known are {known}; set the camera's driver "
            "to one of them"
        )
    kind, values, to_bgr = _ENCODINGS[encoding]
    image = to_bgr(_array(message, where, np.dtype(kind), values, size))
    return np.ascontiguousarray(image)


def _array(
    message: Any, where: str, kind: np.dtype[Any], values: int, size: tuple[int, int] | None
) -> Pixels:
    """The (h, w, values) array of a raw image, or (h, w) if it has one value a pixel."""
    width, (height, step) = int(message.width), _rows_of(message)
    check_not_huge(where, (width, height))
    if size is not None and (width, height) != size:
        raise SequenceError(
            f"{where}: the image is {width}×{height} px, the calibration says {size[0]}×{size[1]}"
        )
    row = width * values * kind.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if not width * height or step < row or len(data) < step * (height - 1) + row:
        raise SequenceError(
            f"{where}: {len(data)} bytes in rows of {step} do not hold {width}×{height} px of "
            f"{message.encoding!r}"
        )
    if len(data) < step * height:
        data = np.pad(data, (0, step * height - len(data)))
    rows = data[: step * height].reshape(height, step)[:, :row]
    stored = kind.newbyteorder(">" if message.is_bigendian else "<")
    pixels = np.ascontiguousarray(rows).view(stored).astype(kind, copy=False)
    return pixels.reshape((height, width, values) if values > 1 else (height, width))


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
    return next(
        (spelling for spelling in (name, bare, bare + _COMPRESSED) if spelling in topics), None
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
        left, right: what the caller named; None finds it. One topic named twice has both sides in
            each image.
        prefer_raw: whether of one camera's topics the raw one is wanted, which the caller's
            calibration describes.
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
        words = list(pattern.finditer(name))
        if words:
            yield pattern.sub(partial(_exchanged, right), name)
        for word in words if len(words) > 1 else ():  # as /left_arm/camera/left/image
            yield name[: word.start()] + _exchanged(right, word) + name[word.end() :]


def _place(name: str) -> int:
    """Where the word for the side stands."""
    return next(match.start(2) for pattern, _ in _PATTERNS if (match := pattern.search(name)))


def _exchanged(right: str, word: re.Match[str]) -> str:
    """The right camera's word for the left one's, in its case."""
    before, left = word.groups()
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
        infos: the topics with `CameraInfo`.
    """
    beside = [_info_beside(image, infos) for image in (stereo.left, stereo.right)]
    if None not in beside and beside[0] != beside[1]:
        return StereoTopics(str(beside[0]), str(beside[1]))
    pairs = list(_pairs(infos))
    if list(_pairs([stereo.left, stereo.right])) == [stereo.exchanged()]:
        pairs = [pair.exchanged() for pair in pairs]
    return max(pairs, key=lambda pair: _shared(pair.left, stereo.left), default=None)


def _shared(name: str, other: str) -> int:
    pairs = enumerate(zip(name, other, strict=False))
    return next((at for at, (a, b) in pairs if a != b), min(len(name), len(other)))


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
