"""Image messages as grey arrays."""

from __future__ import annotations

import numpy as np

# Weights of red, green and blue in luminance, ITU-R BT.601, in 65536ths.
_RED, _GREEN, _BLUE = 19595, 38470, 7471
# First channel and step to the others: where red, green and blue lie in a pixel.
_COLOURS = {
    "rgb8": (0, 1, 2, 3),
    "bgr8": (2, 1, 0, 3),
    "rgba8": (0, 1, 2, 4),
    "bgra8": (2, 1, 0, 4),
}


class ImageError(ValueError):
    """An image message that cannot be used: says what was found, and what is understood."""


def grey(message):
    """The (height, width) uint8 image of a sensor_msgs/Image.

    Raises:
        ImageError: its encoding is not understood, or it has too few bytes.
    """
    encoding, height, width = message.encoding, message.height, message.width
    data = np.frombuffer(message.data, np.uint8)
    if encoding in ("mono8", "8UC1"):
        return _rows(message, data, width, 1)[:, :, 0]
    if encoding in ("mono16", "16UC1"):
        order = ">u2" if message.is_bigendian else "<u2"
        wide = np.ascontiguousarray(_rows(message, data, width, 2)).view(order)[:, :, 0]
        # Cameras store 10 or 12 bits in 16: the brightest pixel tells how many.
        shift = max(int(wide.max(initial=0)).bit_length() - 8, 0)
        return (wide >> shift).astype(np.uint8)
    if encoding in _COLOURS:
        red, green, blue, channels = _COLOURS[encoding]
        pixels = _rows(message, data, width, channels).astype(np.uint32)
        mixed = _RED * pixels[:, :, red] + _GREEN * pixels[:, :, green] + _BLUE * pixels[:, :, blue]
        return ((mixed + 32768) >> 16).astype(np.uint8)
    raise ImageError(
        f"encoding {encoding!r} of a {width} × {height} image is not understood; publish mono8, "
        f"mono16, {', '.join(_COLOURS)}"
    )


def uncompressed(message):
    """The (height, width) uint8 image of a sensor_msgs/CompressedImage.

    Raises:
        ImageError: it cannot be decoded, or OpenCV is missing.
    """
    try:
        import cv2
    except ImportError as error:
        raise ImageError(
            "compressed images need OpenCV: install python3-opencv, or republish them with "
            "image_transport"
        ) from error
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ImageError(f"a compressed image ({message.format!r}) cannot be decoded")
    return image


def _rows(message, data, width: int, bytes_a_pixel: int):
    """The (height, width, bytes_a_pixel) bytes, without the padding at the end of each row."""
    needed = width * bytes_a_pixel
    step = message.step or needed
    if step < needed or data.size < step * message.height:
        raise ImageError(
            f"an image of {width} × {message.height} px, {message.encoding}, has {data.size} bytes "
            f"and rows of {step}"
        )
    rows = data[: step * message.height].reshape(message.height, step)[:, :needed]
    return rows.reshape(message.height, width, bytes_a_pixel)
