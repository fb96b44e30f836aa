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


# Bits that cameras store in 16.
_DEPTHS = (8, 10, 12, 14, 16)
# Bayer patterns: OpenCV names them by the second row's second and third pixel.
_BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
# YUV 4:2:2: which byte of a pixel is its brightness.
_BRIGHTNESS = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}


class ImageError(ValueError):
    """An image message that cannot be used: says what was found, and what is understood."""


class Depth:
    """Bits that cameras use of 16: as many as the brightest pixel so far, of both sides, needs."""

    def __init__(self) -> None:
        self._bits = _DEPTHS[0]

    def eight_bit(self, wide):
        """(h, w) uint16 as uint8."""
        brightest = int(wide.max(initial=0))
        self._bits = max(self._bits, next(bits for bits in _DEPTHS if brightest < 1 << bits))
        return (wide >> (self._bits - 8)).astype(np.uint8)


def grey(message, depth):
    """The (height, width) uint8 image of a sensor_msgs/Image.

    Args:
        message: the image.
        depth: of the cameras, `Depth`, which learns from it.

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
        return depth.eight_bit(wide)
    if encoding in _COLOURS:
        red, green, blue, channels = _COLOURS[encoding]
        pixels = _rows(message, data, width, channels).astype(np.uint32)
        mixed = _RED * pixels[:, :, red] + _GREEN * pixels[:, :, green] + _BLUE * pixels[:, :, blue]
        return ((mixed + 32768) >> 16).astype(np.uint8)
    if encoding in _BRIGHTNESS:
        return np.ascontiguousarray(_rows(message, data, width, 2)[:, :, _BRIGHTNESS[encoding]])
    if encoding.startswith("bayer_") and encoding[6:10] in _BAYER and encoding.endswith("8"):
        cv2 = _opencv("Bayer images")
        pattern = getattr(cv2, f"COLOR_BAYER_{_BAYER[encoding[6:10]]}2GRAY")
        return cv2.cvtColor(_rows(message, data, width, 1)[:, :, 0], pattern)
    raise ImageError(
        f"encoding {encoding!r} of a {width} × {height} image is not understood; publish mono8, "
        f"mono16, {', '.join(_COLOURS)}, yuv422 or bayer_*8"
    )


def uncompressed(message):
    """The (height, width) uint8 image of a sensor_msgs/CompressedImage.

    Raises:
        ImageError: it cannot be decoded, or OpenCV is missing.
    """
    cv2 = _opencv("compressed images")
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ImageError(f"a compressed image ({message.format!r}) cannot be decoded")
    return image


def camera_info(message):
    """A sensor_msgs/CameraInfo with the names of ROS's YAML files."""
    return {
        "image_width": message.width,
        "image_height": message.height,
        "distortion_model": message.distortion_model,
        "distortion_coefficients": _entries(message.d, 1),
        "camera_matrix": _entries(message.k, 3),
        "rectification_matrix": _entries(message.r, 3),
        "projection_matrix": _entries(message.p, 3),
    }


def _entries(values, rows: int):
    data = [float(one) for one in values]
    return {"rows": rows, "cols": len(data) // rows, "data": data}


def _opencv(what: str):
    try:
        import cv2
    except ImportError as error:
        raise ImageError(
            f"{what} need OpenCV: install python3-opencv, or republish them with image_transport "
            "or image_proc"
        ) from error
    return cv2


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
