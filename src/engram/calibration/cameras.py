"""The stereo pair of a drive: the rectified camera, and how raw images become rectified."""

from __future__ import annotations

from dataclasses import dataclass, replace

from engram.geometry import StereoCamera
from engram.geometry.rectification import RawStereoCalibration, Rectification, rectify


@dataclass(frozen=True, slots=True, eq=False)
class Cameras:
    """A calibrated stereo pair.

    Attributes:
        camera: the rectified pair.
        rectification: tables for raw images; None for images that come rectified.
        raw: the raw calibration behind the tables, if it has lenses of a known model.
        field_of_view_deg: chosen horizontal field of view of the rectified images; None for the
            largest without unseen borders.
        topics: names of the left and the right image topic, if the calibration states them.
        right_first: whether the calibration names the right camera first, as cam0.
        sides_doubtful: whether the sign of the baseline says that left and right are exchanged, or
            is wrong itself: the images show which.
        notes: what was read otherwise than it is written, for people.
    """

    camera: StereoCamera
    rectification: Rectification | None = None
    raw: RawStereoCalibration | None = None
    field_of_view_deg: float | None = None
    topics: tuple[str, str] | None = None
    right_first: bool = False
    sides_doubtful: bool = False
    notes: tuple[str, ...] = ()


def rectified_cameras(
    raw: RawStereoCalibration,
    field_of_view_deg: float | None = None,
    topics: tuple[str, str] | None = None,
) -> Cameras:
    """The cameras of a raw calibration.

    Raises:
        CalibrationError: it cannot be rectified.
    """
    rectification = rectify(raw, field_of_view_deg)
    return Cameras(rectification.camera, rectification, raw, field_of_view_deg, topics)


def cameras_in_order(
    chain: RawStereoCalibration,
    field_of_view_deg: float | None = None,
    topics: tuple[str, str] | None = None,
) -> Cameras:
    """The cameras of a calibration that numbers them, where the first may be the right one.

    Args:
        chain: the first camera as `left`, the second as `right`, whichever they are.
        field_of_view_deg: of the rectified images; None for the largest.
        topics: image topics of the first and the second camera.

    Raises:
        CalibrationError: they are not a stereo pair.
    """
    if not chain.is_exchanged:
        return rectified_cameras(chain, field_of_view_deg, topics)
    ordered = rectified_cameras(
        chain.exchanged(), field_of_view_deg, topics and (topics[1], topics[0])
    )
    note = "the calibration has the right camera first: its second camera is read as the left one"
    return replace(ordered, right_first=True, notes=(note,))
