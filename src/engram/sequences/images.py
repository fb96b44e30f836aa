"""Reads an untrusted image file as a grey image.

Sizes are read from the header before decoding, so a small file that claims a gigapixel costs
nothing.
"""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError, SequenceError
from engram.sequences.options import Channel
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


_BGR_INDEX = {Channel.BLUE: 0, Channel.GREEN: 1, Channel.RED: 2}


def read_image(
    path: Path, width: int, height: int, channel: Channel = Channel.GREY
) -> NDArray[np.uint8]:
    """Decode an image as (height, width) uint8 grey, C-contiguous.

    16-bit images are scaled from their full range (65,535 → 255); transparency is dropped.

    Raises:
        SequenceError: the file is missing, cut short, not an image of a known type, or its size is
            not `width` × `height`.
        ConfigError: one colour channel is asked for and the image is grey.
    """
    return grey(path, decoded(path, _read_bytes(path), (width, height)), channel)


def decoded(
    where: object, content: bytes, size: tuple[int, int] | None = None
) -> NDArray[np.generic]:
    """(h, w) or (h, w, 3 or 4) pixels of an encoded image: grey, BGR or BGRA; uint8 or uint16.

    Args:
        where: file or message, for messages.
        content: its bytes.
        size: required width and height, px; None for any.

    Raises:
        SequenceError: it is cut short, of an unknown type, or of another size.
    """
    _check_size(where, header_size(content), size)
    if content.startswith(b"\xff\xd8") and not _jpeg_is_whole(content):
        # libjpeg would fill the missing rows with grey and only warn.
        raise SequenceError(f"{where}: the JPEG is cut short ({len(content)} bytes)")
    image = _decoded(where, content)
    _check_size(where, (image.shape[1], image.shape[0]), size)
    return image


def grey(
    where: object, image: NDArray[np.generic], channel: Channel = Channel.GREY
) -> NDArray[np.uint8]:
    """The (h, w) uint8 grey of a (h, w[, 1, 3, 4]) image of 8 or 16 bit, in OpenCV's BGR order.

    Raises:
        SequenceError: its pixels are of another kind.
        ConfigError: one colour channel is asked for and the image is grey.
    """
    return _one_channel(where, _eight_bit(where, image), channel)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, px, decoded only if its header is not understood.

    Raises:
        SequenceError: the file is missing or not an image.
    """
    content = _read_bytes(path)
    size = header_size(content)
    if size is None:
        height, width = _decoded(path, content).shape[:2]
        size = (width, height)
    check_not_huge(path, size)
    return size


def image_bits(path: Path) -> int | None:
    """Bits of the brightest pixel of a 16-bit image; None for one of 8 bits.

    Raises:
        SequenceError: the file is missing or not an image.
    """
    content = _read_bytes(path)
    size = header_size(content)
    if size is not None:
        check_not_huge(path, size)
    image = _decoded(path, content)
    return int(image.max()).bit_length() if image.dtype == np.uint16 else None


def header_size(content: bytes) -> tuple[int, int] | None:
    """Width and height that a PNG, JPEG, BMP or PNM header claims, px; None for other kinds."""
    try:
        if content.startswith(b"\x89PNG\r\n\x1a\n"):
            return struct.unpack(">II", content[16:24])
        if content.startswith(b"\xff\xd8"):
            return _jpeg_size(content)
        if content.startswith(b"BM"):
            width, height = struct.unpack("<ii", content[18:26])
            return width, abs(height)
        if content[:1] == b"P" and content[1:2] in b"123456":
            return _pnm_size(content)
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


def _decoded(path: object, content: bytes) -> NDArray[np.generic]:
    try:
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise SequenceError(f"{path}: cannot be decoded: {error.err or error}") from error
    if image is None:
        raise SequenceError(
            f"{path}: no readable image ({len(content)} bytes): damaged, cut short, or something "
            "else"
        )
    return image


def _check_size(path: object, size: tuple[int, int] | None, wanted: tuple[int, int] | None) -> None:
    if size is None:
        return
    check_not_huge(path, size)
    if wanted is not None and size != wanted:
        raise SequenceError(
            f"{path}: the image is {size[0]}×{size[1]} px, the calibration says "
            f"{wanted[0]}×{wanted[1]}"
        )


def check_not_huge(path: object, size: tuple[int, int]) -> None:
    """Refuses an image that claims more pixels than any stereo camera delivers.

    Raises:
        SequenceError: it does.
    """
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


def _pnm_size(content: bytes) -> tuple[int, int] | None:
    lines = (line.split(b"#", 1)[0] for line in content[2:1024].split(b"\n"))
    numbers = b" ".join(lines).split()
    if len(numbers) < 2 or max(map(len, numbers[:2])) > 9:
        return None
    return int(numbers[0]), int(numbers[1])


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
