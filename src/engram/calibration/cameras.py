"""The stereo pair of a drive: the rectified camera, and how raw images become rectified."""

from __future__ import annotations

from dataclasses import dataclass

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
    """

    camera: StereoCamera
    rectification: Rectification | None = None
    raw: RawStereoCalibration | None = None
    field_of_view_deg: float | None = None
    topics: tuple[str, str] | None = None


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
