"""Limits of the doctor's checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from engram.config import check_bounds

_SOURCE = "Source: lab/reports/doctor.md"


@dataclass(frozen=True, slots=True)
class DoctorConfig:
    """Settings of `Examination`; beyond a limit a check makes a finding.

    Attributes:
        frames: frames that are examined at the start of a drive; 0 turns the doctor off.
        every: left and right are matched in every so many-th of them.
        least_frames: fewest frames of which anything is said.
        negative_share: largest share of left-right matches that lie to the right in the right
            image. Healthy drives stay below 0.2, swapped sides above 0.8.
        upright: least logarithm of how much further up than down the scene reaches.
        forward_m: distance between the instants of left and right image, metres.
        row_jump_px: scatter of the vertical offset from pair to pair, px.
        row_offset_px, slight_row_offset_px: vertical offset of left and right image, px, RMS over
            the image: fatal, and a warning.
        no_odometry: share of frames without odometry.
        frozen_frames: images in a row that repeat the one before.
        equal_share: share of equal pixels of an image that repeats the one before.
        fixed_share: share of the image that may move with the camera.
        doubted: share of the frames at which part of the image may stand still without a reason.
        gap_ratio: longest interval between frames, in those around it.
        faulty_share: share of the drive's frames that are left out for a wrong stamp.
        jump_s: interval that is a step of the clock, not a gap, s.
        least_rate_hz: slower cameras give odometry no prediction.
        exposure_step: change of brightness from frame to frame, factors of two.
        exposure_difference: difference of brightness of left and right, factors of two.
        saturated, black: share of an image that is white (250 and more), or black (8 and less).
        spoilt_frames: share of frames that may be like that.
        sharpness: least mean square of the second difference along rows, as a share of the
            variance.
        least_px_per_deg: pixels per degree at the middle of the image.
        least_disparity_px: median disparity of the landmarks, px: below it depth is a guess.
        scale: difference of odometry's scale from that of motion from outside, and of focal length
            or baseline from what fits a map, as a share.
        turn_ratio: turn by gyroscope or wheels over that which odometry sees; degrees have 57.
        bits: bits of the brightest pixel of 16-bit images.
        other_size: distance of the principal point from the middle, both down and right, or both
            up and left, in half images. Real calibrations stay below 0.1; half images with the
            calibration of whole ones have 1.
    """

    frames: Annotated[int, Meta(ge=0)] = 200
    every: Annotated[int, Meta(ge=1)] = 3
    least_frames: Annotated[int, Meta(ge=2)] = 10
    negative_share: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    upright: float = -0.25
    forward_m: Annotated[float, Meta(gt=0)] = 0.15
    row_jump_px: Annotated[float, Meta(gt=0)] = 0.25
    row_offset_px: Annotated[float, Meta(gt=0)] = 1.3
    slight_row_offset_px: Annotated[float, Meta(gt=0)] = 0.8
    no_odometry: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    frozen_frames: Annotated[int, Meta(ge=1)] = 2
    equal_share: Annotated[float, Meta(gt=0, le=1)] = 0.9
    fixed_share: Annotated[float, Meta(ge=0, lt=1)] = 0.01
    doubted: Annotated[float, Meta(ge=0, lt=1)] = 0.1
    gap_ratio: Annotated[float, Meta(gt=1)] = 2.5
    faulty_share: Annotated[float, Meta(gt=0, le=1)] = 0.05
    jump_s: Annotated[float, Meta(gt=0)] = 60.0
    least_rate_hz: Annotated[float, Meta(gt=0)] = 4.0
    exposure_step: Annotated[float, Meta(gt=0)] = 0.8
    exposure_difference: Annotated[float, Meta(gt=0)] = 0.5
    saturated: Annotated[float, Meta(gt=0, lt=1)] = 0.4
    black: Annotated[float, Meta(gt=0, lt=1)] = 0.6
    spoilt_frames: Annotated[float, Meta(gt=0, lt=1)] = 0.03
    sharpness: Annotated[float, Meta(gt=0)] = 0.002
    least_px_per_deg: Annotated[float, Meta(gt=0)] = 4.0
    least_disparity_px: Annotated[float, Meta(gt=0)] = 2.0
    scale: Annotated[float, Meta(gt=0)] = 0.05
    turn_ratio: Annotated[float, Meta(gt=1)] = 8.0
    bits: Annotated[int, Meta(ge=1, le=16)] = 14
    other_size: Annotated[float, Meta(gt=0)] = 0.25

    def __post_init__(self) -> None:
        check_bounds(self)
