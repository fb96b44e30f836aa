"""The cameras of a drive: its own calibration, or that of `--calibration`; and its mask."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import Cameras
from engram.calibration.formats import read_calibration
from engram.errors import CalibrationError, ConfigError, InputError
from engram.frontend.features import match_sides
from engram.frontend.frame import StereoPair
from engram.sequences.images import image_size, read_image
from engram.sequences.listing import image_files
from engram.sequences.sequence import OpenOptions

# Disparities below this have no sign, px; so many others tell left from right, and such a share of
# them is negative where the two are exchanged.
_NO_DISPARITY_PX = 1.0
_ENOUGH = 80
_EXCHANGED = 0.5
# Pairs of a drive that are looked at, at most: every fifth, as the first may be dark.
TELLING = slice(0, 300, 5)


def cameras_of(
    options: OpenOptions,
    own: Callable[[], Cameras],
    folder: Path | None = None,
    *,
    rectified: bool = False,
) -> Cameras:
    """The calibration that the caller gave, or else the drive's own.

    Args:
        own: reads the drive's own calibration.
        folder: of the left images, for calibrations that state no image size.
    """
    if options.calibration is None:
        return own()
    return cameras_given(options, folder, rectified=rectified)


def cameras_given(
    options: OpenOptions,
    folder: Path | None,
    *,
    rectified: bool = False,
    halves: bool = False,
) -> Cameras:
    """The calibration that the caller gave; see `cameras_of`."""
    assert options.calibration is not None
    return read_calibration(
        options.calibration,
        rectified=rectified,
        size=None if folder is None else (lambda: _size_in(folder, halves=halves)),
        field_of_view_deg=options.field_of_view_deg,
    )


def _size_in(folder: Path, *, halves: bool) -> tuple[int, int]:
    width, height = image_size(image_files(folder)[0])
    return (width // 2, height) if halves else (width, height)


def read_mask(path: Path, cameras: Cameras) -> NDArray[np.bool_]:
    """What a mask leaves visible, in the rectified left image.

    Args:
        path: an image of the size of the drive's own images: white is used, black is left out,
            such as the robot's own body.

    Returns:
        (height, width) bool, False where nothing is used.
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
        raise ConfigError(f"mask {path}: is entirely black; white marks what is used")
    return mask


def scaled_by(stated: tuple[int, int], size: tuple[int, int]) -> str:
    """How a calibration of scaled images is mended; "" if the images are not scaled ones.

    Args:
        stated: width and height that the calibration states, px.
        size: those of the images, px.
    """
    ratio = size[0] / stated[0]
    if stated == size or abs(ratio * stated[1] - size[1]) > 1:
        return ""
    return (
        f"; if the images were scaled, multiply fx, fy, cx and cy of the calibration by "
        f"{ratio:.6g}, and state width {size[0]} and height {size[1]}"
    )


def check_sides(cameras: Cameras, pairs: Iterable[StereoPair], where: object) -> None:
    """Refuses a drive whose images agree that its left and right are exchanged.

    Nothing is looked at unless the calibration's sign raises the doubt.

    Args:
        pairs: some of its rectified pairs; read until they decide.
    """
    if not cameras.sides_doubtful:
        return
    shifts: list[float] = []
    for pair in pairs:
        shifts += match_sides(pair).shift[:, 0].tolist()
        shifts = [shift for shift in shifts if abs(shift) > _NO_DISPARITY_PX]
        if len(shifts) >= _ENOUGH:
            break
    if len(shifts) < _ENOUGH:
        raise CalibrationError(
            f"{where}: are left and right swapped? the projections state a negative baseline, and "
            "the images cannot decide; exchange them, or make P[3] of the right camera negative, "
            "−fx·baseline"
        )
    if np.mean(np.array(shifts) < 0) > _EXCHANGED:
        raise CalibrationError(
            f"{where}: left and right are swapped: the projections state a negative baseline, and "
            "near things lie further right in the right images; exchange the two folders, or "
            "topics (--left, --right)"
        )


def mask_image(seen: NDArray[np.bool_], cameras: Cameras) -> NDArray[np.uint8]:
    """An image for `read_mask` that leaves out what is not seen; the inverse of that.

    Args:
        seen: (height, width) bool of the rectified left image.

    Returns:
        (h, w) uint8 of the size of the drive's own images: 255 is used, 0 is left out.
    """
    image = np.where(seen, 255, 0).astype(np.uint8)
    if cameras.rectification is None:
        return image
    raw = np.zeros_like(image)
    columns, rows = cameras.rectification.left.pixels[~seen].T
    height, width = raw.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    raw[rows[inside], columns[inside]] = 255
    closed = cv2.morphologyEx(raw, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return np.asarray(255 - closed, np.uint8)


def check_no_view(options: OpenOptions, cameras: Cameras) -> None:
    """Refuses a chosen field of view for images that come rectified."""
    if options.field_of_view_deg is not None and cameras.rectification is None:
        raise CalibrationError(
            "the images are rectified already: drive.field_of_view_deg is for raw images "
            "and their calibration"
        )
