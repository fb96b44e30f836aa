"""Image messages as grey images: raw in every usual encoding, or compressed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import SequenceError
from engram.sequences.images import check_not_huge, decoded, grey
from engram.sequences.options import Channel

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
        where: topic and place, for messages.
        size: required width and height, px; None for any.
        channel: of colour images.
        bits: that are used of 16-bit images; brighter pixels are white.

    Raises:
        SequenceError: its encoding is unknown, or its bytes do not fit.
        ConfigError: one colour channel is requested and the image is grey.
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
    """Width and height of an image message, px.

    Raises:
        SequenceError: it cannot be decoded.
    """
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
