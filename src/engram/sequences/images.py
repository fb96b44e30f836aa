"""Reads an untrusted image file as a grey image.

Sizes are read from the header before decoding, so a small file that claims a gigapixel costs
nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError, SequenceError
from engram.sequences.sequence import Channel
from engram.untrusted import read_bytes

# File types that OpenCV's wheels decode. Other files beside the images are ignored.
IMAGE_SUFFIXES = frozenset(
    f".{ending}"
    for ending in (
        *("png", "jpg", "jpeg", "jpe", "jp2", "bmp", "dib", "pgm", "ppm"),
        *("pnm", "pbm", "tif", "tiff", "webp", "avif", "ras", "sr"),
    )
)

# An uncompressed 16-bit colour image of 64 megapixels fits: more than any stereo camera delivers.
_MAX_FILE_BYTES = 400_000_000
_MAX_PIXELS = 64_000_000


# A header with its comments and colour profiles.
_HEADER_BYTES = 1_000_000
_TIFF_ENTRIES = 1000
_TIFF_NUMBERS = {3: "H", 4: "I", 16: "Q"}

_BGR_INDEX = {Channel.BLUE: 0, Channel.GREEN: 1, Channel.RED: 2}


def read_image(
    path: Path, width: int, height: int, channel: Channel = Channel.GREY
) -> NDArray[np.uint8]:
    """Decode an image as (height, width) uint8 grey, C-contiguous.

    16-bit images are scaled from their full range (65,535 → 255); transparency is dropped.
    """
    return grey(path, decoded(path, _read_bytes(path), (width, height)), channel)


def decoded(
    where: object, content: bytes, size: tuple[int, int] | None = None
) -> NDArray[np.generic]:
    """(h, w) or (h, w, 3 or 4) pixels of an encoded image: grey, BGR or BGRA; uint8 or uint16.

    Args:
        size: required width and height, px; None for any.
    """
    _check_size(where, _claimed(where, content), size)
    if content.startswith(b"\xff\xd8") and not _jpeg_is_whole(content):
        # libjpeg would fill the missing rows with grey and only warn.
        raise SequenceError(f"{where}: the JPEG is cut short ({len(content)} bytes)")
    image = _decoded(where, content)
    _check_size(where, (image.shape[1], image.shape[0]), size)
    return image


def grey(
    where: object, image: NDArray[np.generic], channel: Channel = Channel.GREY
) -> NDArray[np.uint8]:
    """The (h, w) uint8 grey of a (h, w[, 1, 3, 4]) image of 8 or 16 bit, in OpenCV's BGR order."""
    return _one_channel(where, _eight_bit(where, image), channel)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, px, by its header."""
    size = _claimed(path, _read_bytes(path))
    check_not_huge(path, size)
    return size


def image_bits(path: Path) -> int | None:
    """Bits of the brightest pixel of a 16-bit image; None for one of 8 bits."""
    content = _read_bytes(path)
    check_not_huge(path, _claimed(path, content))
    image = _decoded(path, content)
    return int(image.max()).bit_length() if image.dtype == np.uint16 else None


def header_size(content: bytes) -> tuple[int, int] | None:
    """Width and height that an image's header claims, px; None if the format is unknown."""
    for begins, size_in in _SIZES:
        if content.startswith(begins):
            try:
                return size_in(content)
            except (struct.error, ValueError):
                return None
    return None


def _read_bytes(path: Path) -> bytes:
    if not path.exists():
        raise SequenceError(f"{path}: the image is missing")
    content = read_bytes(path, _MAX_FILE_BYTES)
    if not content:
        raise SequenceError(f"{path}: the image is empty (0 bytes)")
    return content


def _claimed(where: object, content: bytes) -> tuple[int, int]:
    size = header_size(content)
    if size is None:
        raise _unreadable(where, content)
    return size


def _unreadable(where: object, content: bytes) -> SequenceError:
    return SequenceError(
        f"{where}: not a readable image ({len(content)} bytes): damaged, cut short, or "
        "another kind of file"
    )


def _decoded(path: object, content: bytes) -> NDArray[np.generic]:
    try:
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise SequenceError(f"{path}: cannot be decoded: {error.err or error}") from error
    if image is None:
        raise _unreadable(path, content)
    return image


def _check_size(path: object, size: tuple[int, int], wanted: tuple[int, int] | None) -> None:
    check_not_huge(path, size)
    if wanted is not None and size != wanted:
        raise SequenceError(
            f"{path}: the image is {size[0]}×{size[1]} px, the calibration says "
            f"{wanted[0]}×{wanted[1]}"
        )


def check_not_huge(path: object, size: tuple[int, int]) -> None:
    """Refuses an image that claims more pixels than any stereo camera delivers."""
    if size[0] * size[1] > _MAX_PIXELS:
        raise SequenceError(
            f"{path}: claims {size[0]}×{size[1]} px, more than {_MAX_PIXELS:,}: not decoded"
        )


def _jpeg_segments(content: bytes) -> tuple[tuple[int, int] | None, int]:
    """Size in the frame header (None if there is none) and the start of the first scan (-1)."""
    position, size = 2, None
    while position + 4 <= len(content) and content[position] == 0xFF:
        marker = content[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        (length,) = struct.unpack(">H", content[position + 2 : position + 4])
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            height, width = struct.unpack(">HH", content[position + 5 : position + 9])
            size = (width, height)
        position += 2 + length
        if marker == 0xDA:
            return size, position
    return size, -1


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    return _jpeg_segments(content)[0]


def _jpeg_is_whole(content: bytes) -> bool:
    """Whether an end marker follows the first scan; within scan data FF D9 cannot occur."""
    try:
        _, scan = _jpeg_segments(content)
    except struct.error:
        return False
    return scan > 0 and content.find(b"\xff\xd9", scan) >= 0


def _png_size(content: bytes) -> tuple[int, int]:
    return struct.unpack(">II", content[16:24])


def _bmp_size(content: bytes) -> tuple[int, int]:
    (header,) = struct.unpack("<I", content[14:18])
    if header == 12:  # of OS/2
        return struct.unpack("<HH", content[18:22])
    width, height = struct.unpack("<ii", content[18:26])
    return width, abs(height)


def _pnm_size(content: bytes) -> tuple[int, int] | None:
    if content[1:2] not in b"123456":
        return None
    lines = (line.split(b"#", 1)[0] for line in content[2:_HEADER_BYTES].split(b"\n"))
    numbers = b" ".join(lines).split(maxsplit=2)
    if len(numbers) < 2 or max(map(len, numbers[:2])) > 9:
        return None
    return int(numbers[0]), int(numbers[1])


def _tiff_size(content: bytes) -> tuple[int, int] | None:
    """Of the first image: OpenCV decodes that."""
    order = "<" if content[:2] == b"II" else ">"
    (version,) = struct.unpack(f"{order}H", content[2:4])
    big = version == 43
    where, count, row = ("Q", "Q", "HHQ8s") if big else ("I", "H", "HHI4s")
    at, entry = 8 if big else 4, struct.Struct(order + row)
    (at,) = struct.unpack_from(order + where, content, at)
    (entries,) = struct.unpack_from(order + count, content, at)
    at += struct.calcsize(order + count)
    found: dict[int, int] = {}
    for number in range(min(entries, _TIFF_ENTRIES)):
        tag, kind, _, value = entry.unpack_from(content, at + number * entry.size)
        if tag in {256, 257} and kind in _TIFF_NUMBERS:
            (found[tag],) = struct.unpack_from(order + _TIFF_NUMBERS[kind], value)
    return (found[256], found[257]) if len(found) == 2 else None


def _webp_size(content: bytes) -> tuple[int, int] | None:
    match content[8:16]:
        case b"WEBPVP8 ":
            width, height = struct.unpack("<HH", content[26:30])
            return width & 0x3FFF, height & 0x3FFF
        case b"WEBPVP8L":
            (bits,) = struct.unpack("<I", content[21:25])
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        case b"WEBPVP8X":
            sides = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (24, 27))
            return next(sides), next(sides)
    return None


def _jpeg_2000_size(content: bytes) -> tuple[int, int] | None:
    """The largest that any code stream claims, whatever the boxes around say."""
    return _largest(content, b"\xff\x4f\xff\x51", 8)


def _avif_size(content: bytes) -> tuple[int, int] | None:
    return _largest(content, b"ispe", 8) if content[4:8] == b"ftyp" else None


def _largest(content: bytes, mark: bytes, after: int) -> tuple[int, int] | None:
    """The largest width and height of those that stand behind a mark in the header."""
    sizes, at = list[tuple[int, int]](), content.find(mark, 0, _HEADER_BYTES)
    while at >= 0:
        sizes.append(struct.unpack_from(">II", content, at + after))
        at = content.find(mark, at + 1, _HEADER_BYTES)
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def _sun_raster_size(content: bytes) -> tuple[int, int]:
    return struct.unpack(">II", content[4:12])


# How the images of each kind begin, and where they claim their size. What is not here is not
# decoded: OpenCV knows more kinds, and makes all that a file of a few bytes claims.
_SIZES: tuple[tuple[bytes, Callable[[bytes], tuple[int, int] | None]], ...] = (
    (b"\x89PNG\r\n\x1a\n", _png_size),
    (b"\xff\xd8", _jpeg_size),
    (b"BM", _bmp_size),
    (b"P", _pnm_size),
    (b"II*\0", _tiff_size),
    (b"MM\0*", _tiff_size),
    (b"II+\0", _tiff_size),
    (b"MM\0+", _tiff_size),
    (b"RIFF", _webp_size),
    (b"\0\0\0\x0cjP  ", _jpeg_2000_size),
    (b"\xff\x4f\xff\x51", _jpeg_2000_size),
    (b"\x59\xa6\x6a\x95", _sun_raster_size),
    (b"\0\0\0", _avif_size),
)


def _eight_bit(path: object, image: NDArray[np.generic]) -> NDArray[np.uint8]:
    if image.dtype == np.uint8:
        return image.view(np.uint8)
    if image.dtype == np.uint16:
        # 257 maps 65,535 to 255 exactly; fixed for all images, so that brightness stays comparable.
        return np.asarray((image.astype(np.uint32) + 128) // 257, dtype=np.uint8)
    raise SequenceError(f"{path}: pixels are {image.dtype}, need 8 or 16 bit unsigned")


def _one_channel(path: object, image: NDArray[np.uint8], channel: Channel) -> NDArray[np.uint8]:
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels not in {1, 3, 4}:
        raise SequenceError(f"{path}: {channels} channels, need 1, 3 or 4")
    if channels == 1:
        if channel is not Channel.GREY:
            raise ConfigError(
                f"{path}: the image is grey and has no channel {channel.value!r}; "
                "leave the channel at 'grey' or choose the colour rig"
            )
        return np.ascontiguousarray(image.reshape(image.shape[:2]))
    if channel is Channel.GREY:
        code = cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY
        return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)
    return np.ascontiguousarray(image[:, :, _BGR_INDEX[channel]])
