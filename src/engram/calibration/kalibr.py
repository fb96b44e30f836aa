"""Kalibr's `camchain.yaml`: two pinhole cameras with radtan or equidistant lenses.

Source: Kalibr wiki, "Yaml formats": intrinsics [fu, fv, pu, pv]; ``T_cn_cnm1`` takes points from
the previous camera of the chain to this one; ``T_cam_imu`` from the IMU to the camera. The chain
has the cameras in the order in which their topics were named: either may be the left one.
"""

from __future__ import annotations

from typing import Any

from engram.calibration.cameras import Cameras, cameras_in_order
from engram.calibration.entries import (
    entry,
    lens_of,
    numbers,
    transform,
    whole,
)
from engram.errors import CalibrationError
from engram.geometry.rectification import RawCamera, RawStereoCalibration


def is_camchain(entries: dict[str, Any]) -> bool:
    """Whether the file holds cameras of a chain."""
    return isinstance(entries.get("cam0"), dict)


def parse_camchain(entries: dict[str, Any], field_of_view_deg: float | None = None) -> Cameras:
    """The first two cameras of a chain, in either order, and their image topics.

    Raises:
        CalibrationError: an entry is missing, malformed, or of a kind that is not supported; or the
            cameras are not a stereo pair.
    """
    sides = [entry(entries, name) for name in ("cam0", "cam1")]
    lenses = []
    for name, side in zip(("cam0", "cam1"), sides, strict=True):
        if not isinstance(side, dict):
            raise CalibrationError(f"{name} is not a table")
        try:
            lenses.append(_lens(side))
        except CalibrationError as error:
            raise CalibrationError(f"{name}: {error}") from error
    first, second = sides
    second_from_first = transform(second, "T_cn_cnm1")
    first_from_rig = transform(first, "T_cam_imu") if "T_cam_imu" in first else None
    topics = (str(first.get("rostopic", "")), str(second.get("rostopic", "")))
    chain = RawStereoCalibration(lenses[0], lenses[1], second_from_first, first_from_rig)
    return cameras_in_order(chain, field_of_view_deg, topics if all(topics) else None)


def _lens(side: dict[str, Any]) -> RawCamera:
    stated = entry(side, "camera_model")
    model = stated.strip().lower() if isinstance(stated, str) else "no text"
    if model != "pinhole":
        raise CalibrationError(
            f"camera_model is {model[:40]!r}, only 'pinhole' is supported; calibrate again with "
            "Kalibr's models pinhole-radtan, or pinhole-equi for a wide lens"
        )
    fx, fy, cx, cy = numbers(side, "intrinsics", {4})
    width, height = (whole(value) for value in numbers(side, "resolution", {2}))
    lens = lens_of(
        entry(side, "distortion_model"),
        lambda counts: numbers(side, "distortion_coeffs", counts),
    )
    return RawCamera(fx, fy, cx, cy, width, height, *lens)
