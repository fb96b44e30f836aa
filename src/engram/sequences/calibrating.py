"""The cameras of a drive: its own calibration, or that of `--calibration`; and its mask."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration import Cameras, read_calibration
from engram.errors import CalibrationError, ConfigError, InputError
from engram.sequences.images import image_size, read_image
from engram.sequences.listing import image_files
from engram.sequences.options import OpenOptions


def cameras_of(
    options: OpenOptions,
    own: Callable[[], Cameras],
    folder: Path | None = None,
    *,
    rectified: bool = False,
) -> Cameras:
    """The calibration that the caller gave, or else the drive's own.

    Args:
        options: how the drive is opened.
        own: reads the drive's own calibration.
        folder: of the left images, for calibrations that state no image size.
        rectified: whether the images are rectified.

    Raises:
        CalibrationError: it cannot be used.
    """
    if options.calibration is None:
        return own()
    return read_calibration(
        options.calibration,
        rectified=rectified,
        size=None if folder is None else (lambda: image_size(image_files(folder)[0])),
        field_of_view_deg=options.field_of_view_deg,
    )


def read_mask(path: Path, cameras: Cameras) -> NDArray[np.bool_]:
    """What a mask leaves visible, in the rectified left image.

    Args:
        path: an image of the size of the drive's own images: white is used, black is left out,
            such as the robot's own body.
        cameras: of the drive.

    Returns:
        (height, width) bool, False where nothing is used.

    Raises:
        ConfigError: the image cannot be read, has another size, or is black throughout.
    """
    camera = cameras.camera
    try:
        image = read_image(path, camera.width, camera.height)
    except InputError as error:
        raise ConfigError(f"mask {error}") from error
    if cameras.rectification is not None:
        table = cameras.rectification.left
        image = np.asarray(
            cv2.remap(image, table.pixels, table.fractions, cv2.INTER_NEAREST), dtype=np.uint8
        )
    mask: NDArray[np.bool_] = image > 127
    if not mask.any():
        raise ConfigError(f"mask {path}: is black throughout; white is what is used")
    return mask


def check_no_view(options: OpenOptions, cameras: Cameras) -> None:
    """Refuses a chosen field of view for images that come rectified.

    Raises:
        CalibrationError: they do.
    """
    if options.field_of_view_deg is not None and cameras.rectification is None:
        raise CalibrationError(
            "the images are rectified already: --fov is for raw images and their calibration"
        )
