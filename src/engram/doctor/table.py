"""All checks of the doctor in one table: measure, limit, meaning, cure; and their findings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.config import plain
from engram.counts import counted
from engram.doctor import checks
from engram.doctor.examination import Evidence


class Severity(StrEnum):
    """How bad a finding is.

    `FATAL`: what is mapped from such a drive is wrong or useless. `WARNING`: it serves less well
    than it could. `NOTE`: something that only some uses need.
    """

    FATAL = "fatal"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a drive.

    Attributes:
        code: name of the check, see `CHECKS`.
        message: what is wrong, in words.
    """

    code: str
    severity: Severity
    message: str
    value: float
    limit: float
    unit: str
    cure: str

    def text(self) -> str:
        """For people: two lines."""
        measured = measure_text(self.value, self.limit, self.unit)
        return f"{self.severity}: {self.code}: {self.message} ({measured})\n  {self.cure}"


def measure_text(value: float, limit: float, unit: str) -> str:
    """A measured value and its limit, shares of something as percentages."""
    shares = unit.startswith("of the ")
    shown, most = (f"{100 * one:.3g}%" if shares else f"{one:.3g}" for one in (value, limit))
    return f"{shown} {unit}".strip() + f", limit {most}"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """All findings of an examination, the worst first.

    Attributes:
        frames: how many frames were examined.
        untold: checks that could not be made, and what they would need, by code.
        seen: (height, width) bool of the rectified left image, False where it moves with the
            camera; None if nothing does.
    """

    frames: int
    findings: tuple[Finding, ...]
    untold: dict[str, str]
    seen: NDArray[np.bool_] | None = field(default=None, compare=False, repr=False)

    @property
    def fatal(self) -> tuple[Finding, ...]:
        """The findings for which the drive should not be mapped."""
        return tuple(finding for finding in self.findings if finding.severity is Severity.FATAL)

    def text(self) -> str:
        """For people."""
        lines = [finding.text() for finding in self.findings]
        lines += [f"not checked: {code} needs {needs}" for code, needs in self.untold.items()]
        alarms = sum(finding.severity is not Severity.NOTE for finding in self.findings)
        found = (
            "nothing wrong"
            if not alarms
            else f"{len(self.fatal)} of {counted(alarms, 'finding')} fatal"
        )
        return "\n".join([f"{counted(self.frames, 'frame')} examined: {found}", *lines])

    def to_dict(self) -> dict[str, Any]:
        """What ``doctor --json`` prints."""
        return {
            "frames": self.frames,
            "fatal": bool(self.fatal),
            "findings": [plain(finding) for finding in self.findings],
            "untold": self.untold,
        }


@dataclass(frozen=True, slots=True)
class Check:
    """One check.

    Attributes:
        code: name of its finding; two checks may share one, the first that alarms counts.
        measure: the value; None if undetermined.
        limit: field of `DoctorConfig` that bounds the value, or the bound itself.
        message: what is wrong beyond the limit, in words.
        advice: the same in the light of what was seen; None where that adds nothing.
        example: one of the things that are wrong, for the message.
        below: whether values below the limit are the alarm, not those above.
        needs: what the check would need, for the report; "" if not worth reporting.
        explains: codes whose findings would only be its consequences.
    """

    code: str
    severity: Severity
    measure: Callable[[Evidence], float | None]
    limit: str | float
    unit: str
    message: str
    cure: str
    advice: Callable[[Evidence], str] | None = None
    example: Callable[[Evidence], str] | None = None
    below: bool = False
    needs: str = ""
    explains: tuple[str, ...] = ()

    def finding(self, seen: Evidence) -> Finding | float | None:
        """The finding; else the value, which is None if undetermined."""
        value = self.measure(seen)
        limit = getattr(seen.config, self.limit) if isinstance(self.limit, str) else self.limit
        if value is None or not (value < limit if self.below else value > limit):
            return value
        message = self.message + (f", such as: {self.example(seen)}" if self.example else "")
        cure = self.cure if self.advice is None else self.advice(seen)
        return Finding(self.code, self.severity, message, value, float(limit), self.unit, cure)


_FATAL, _WARNING, _NOTE = Severity
_CONSEQUENCES = ("no_odometry", "rows_misaligned", "rows_slightly_off", "scale_off", "upside_down")

CHECKS: tuple[Check, ...] = (
    Check(
        "stamps_unreliable", _FATAL, checks.faulty_share, "faulty_share", "of the frames",
        "stamps are wrong, and their frames are left out",
        "look at the driver and the clock that stamp the images; record again",
        explains=("stamps_backwards",),
    ),
    Check(
        "stamps_counted", _FATAL, checks.counted, 0.9, "of the frames",
        "the stamps are the numbers of the frames, 0, 1, 2 …, not times",
        "write the time of each frame, in seconds; speeds, gaps and hours come from it",
        explains=("low_frame_rate",),
    ),
    Check(
        "sides_swapped", _FATAL, checks.swapped, "negative_share", "of the matches",
        "left and right are swapped: near things lie further right in the right image",
        "exchange the two folders, or topics (--left, --right), and the two halves of a raw "
        "calibration",
        explains=_CONSEQUENCES,
    ),
    Check(
        "images_rotated", _FATAL, checks.rotated, "negative_share", "of the matches",
        "each image is turned by 180° in its place",
        "turn the images back, or exchange left and right: a rig that hangs upside down has both",
        explains=_CONSEQUENCES,
    ),
    Check(
        "not_synchronised", _FATAL, checks.forward_m, "forward_m", "m",
        "left and right are not synchronised: the robot moved between them",
        "trigger both cameras at once, or pair by the time of exposure; check for a dropped frame",
        explains=_CONSEQUENCES,
    ),
    Check(
        "not_synchronised", _FATAL, checks.row_jump_px, "row_jump_px", "px",
        "left and right are not synchronised: their rows jump from pair to pair",
        "trigger both cameras at once, or pair by the time of exposure; check for a dropped frame",
        explains=_CONSEQUENCES,
    ),
    Check(
        "rows_misaligned", _FATAL, checks.row_offset_px, "row_offset_px", "px",
        "rows of left and right are not aligned",
        "are left and right exchanged? otherwise calibrate again; raw images need a [raw] "
        "calibration, so that they are rectified",
        # In rows that do not correspond, motion down the image looks like a lag.
        explains=("no_odometry", "rows_slightly_off", "not_synchronised"),
    ),
    Check(
        "not_synchronised", _FATAL, checks.frames_late, 0, "frames",
        "left and right are not synchronised: one shows what the other has shown before",
        "pair the images by their time of exposure; look for a dropped frame",
        explains=_CONSEQUENCES,
    ),
    Check(
        "frozen_stream", _FATAL, checks.frozen_frames, "frozen_frames", "images in a row",
        "a camera repeats an old image under new stamps",
        "look at the camera's driver and its bandwidth; record again",
        explains=("repeated_images",),
    ),
    Check(
        "no_odometry", _FATAL, checks.without_odometry, "no_odometry", "of the frames",
        "most frames have no odometry",
        "are the images dark, covered or without texture? is the baseline in metres, and is "
        "the calibration that of these images?",
    ),
    Check(
        "rows_slightly_off", _WARNING, checks.row_offset_px, "slight_row_offset_px", "px",
        "rows of left and right are slightly misaligned: half of the landmarks are lost",
        "calibrate again when you can",
    ),
    Check(
        "upside_down", _WARNING, checks.upside_down, "upright", "",
        "the camera hangs upside down: the scene ends above it like ground",
        "this works if all drives of the map are like this; otherwise turn the images",
        below=True,
    ),
    Check(
        "scale_off", _WARNING, checks.scale_off, "scale", "of the distance",
        "odometry and --motion disagree on distance: wrong focal length, baseline, or unit of the "
        "motion",
        "see that --motion is in metres and radians; calibrate again; check the baseline with a "
        "ruler",
        needs="motion from outside, --motion TOPIC or FILE, and odometry that is sure of its steps",
    ),
    Check(
        "turns_in_degrees", _WARNING, checks.turn_ratio, "turn_ratio", "times what odometry sees",
        "gyroscope or wheels turn much further than the images: in degrees, it seems; they are "
        "left aside",
        "give --motion in radians per second: degrees divided by 57.3",
    ),
    Check(
        "focal_length_off", _WARNING, checks.focal_too_long, "scale", "of the right one",
        "the focal length is too long: with another one images fit the map better; positions "
        "are off by metres",
        "calibrate again, with images of this size; if it is the map that is wrong, map its "
        "first drives again",
        needs="a map: engram localise reports it",
    ),
    Check(
        "focal_length_off", _WARNING, checks.focal_too_short, "scale", "of the right one",
        "the focal length is too short: with another one images fit the map better; positions "
        "are off by metres",
        "calibrate again, with images of this size; if it is the map that is wrong, map its "
        "first drives again",
        needs="a map: engram localise reports it",
    ),
    Check(
        "baseline_off", _WARNING, checks.baseline_too_long, "scale", "of the right one",
        "the baseline is too long, and with it all distances: with another one images fit the "
        "map better",
        "check the distance of the lenses with a ruler; calibrate again; if it is the map that is "
        "wrong, map its first drives again",
        needs="a map: engram localise reports it",
    ),
    Check(
        "baseline_off", _WARNING, checks.baseline_too_short, "scale", "of the right one",
        "the baseline is too short, and with it all distances: with another one images fit the "
        "map better",
        "check the distance of the lenses with a ruler; calibrate again; if it is the map that is "
        "wrong, map its first drives again",
        needs="a map: engram localise reports it",
    ),
    Check(
        "stamps_backwards", _WARNING, checks.faulty, 0, "frames",
        "frames are stamped before, or far after, their neighbours",
        "they are left out; look at the driver that stamps the images",
    ),
    Check(
        "clock_set", _WARNING, checks.steps, 0, "steps",
        "the clock was set during the drive",
        "nothing is lost: times are counted on from there; let the clock be set before a drive "
        "begins, or slew it",
    ),
    Check(
        "stamps_repeated", _WARNING, checks.repeated, 0, "frames",
        "frames repeat the stamp of the frame before",
        "the driver sends frames twice, or the clock is too coarse; they are left out",
    ),
    Check(
        "bad_pairs", _WARNING, checks.bad_pairs, 0, "pairs",
        "pairs cannot be used",
        "mend or remove their images, or leave the pairs out with --set drive.skip_bad=true",
        example=lambda seen: seen.bad[0],
    ),
    Check(
        "stamp_jump", _WARNING, checks.jump_s, "jump_s", "s",
        "the stamps jump forwards",
        "a pause, or a clock that was set; nothing is lost by it",
    ),
    Check(
        "frame_gaps", _WARNING, checks.gap_ratio, "gap_ratio", "usual intervals",
        "frames are missing",
        "the map may fall into parts at gaps; check bandwidth and disk",
    ),
    Check(
        "low_frame_rate", _WARNING, checks.rate_hz, "least_rate_hz", "Hz",
        "few frames per second: odometry has no prediction from one to the next",
        "record with at least 4 Hz, better 10; or are the time stamps in milliseconds, not "
        "seconds?",
        below=True,
    ),
    Check(
        "repeated_images", _WARNING, checks.frozen_frames, 0, "images in a row",
        "an image repeats the frame before",
        "the frame counts as unusable; look at the camera's driver",
    ),
    Check(
        "fixed_to_camera", _WARNING, checks.fixed_share, "fixed_share", "of the image",
        "part of the image moves with the camera, such as a bonnet, a gripper or dirt; it is left "
        "out",
        "clean the lens, or leave that part out from the first frame on: engram doctor DRIVE "
        "--pictures DIR draws it and writes DIR/mask.png for drive.mask",
    ),
    Check(
        "stands_still_in_part", _WARNING, checks.doubted, "doubted", "of the frames",
        "part of the image stands still while the rest moves, and it is open which of them is the "
        "world; no position is taken from such frames",
        "give --motion with wheels or a gyroscope, or drive.mask with what is fixed to the camera "
        "in black",
    ),
    Check(
        "overexposed", _WARNING, checks.saturated, "spoilt_frames", "of the frames",
        "much of the image is white",
        "limit the exposure, or meter the lower half of the image",
    ),
    Check(
        "black", _WARNING, checks.black, "spoilt_frames", "of the frames",
        "much of the image is black",
        "allow a longer exposure or more gain; is the lens covered?",
    ),
    Check(
        "exposure_steps", _WARNING, checks.exposure_step, "exposure_step", "factors of two",
        "the exposure jumps from frame to frame",
        "use the camera's smooth exposure control, the same for both sides",
    ),
    Check(
        "sides_exposed_differently", _WARNING, checks.exposure_difference,
        "exposure_difference", "factors of two",
        "left and right differ in brightness: the darker one measures with fewer grey levels",
        "clean both lenses, and let one camera control the exposure of both",
    ),
    Check(
        "blurred", _WARNING, checks.sharpness, "sharpness", "",
        "the images are blurred",
        "focus or clean the lens, shorten the exposure, compress less",
        below=True,
    ),
    Check(
        "few_grey_levels", _WARNING, checks.bits, "bits", "bits",
        "16-bit images use only their lowest bits, such as 10 of 16",
        "shift the values up, or write 8-bit images",
        below=True,
    ),
    Check(
        "principal_point_off", _WARNING, checks.other_size, "other_size", "of the half image",
        "the principal point is far off the middle, as if the calibration were that of images of "
        "another size",
        "resize the calibration with the images: fx, fy, cx and cy by the same factor; all is well "
        "if the images are one corner of larger ones",
    ),
    Check(
        "low_resolution", _WARNING, checks.px_per_deg, "least_px_per_deg", "px per degree",
        "few pixels per degree: landmarks further off cannot be distinguished",
        "use larger images or a narrower lens",
        below=True,
    ),
    Check(
        "short_baseline", _WARNING, checks.disparity_px, "least_disparity_px", "px",
        "the baseline is too short for the scene: most landmarks are too far off to measure",
        "use a rig with a longer baseline, or a longer focal length",
        below=True,
    ),
    Check(
        "clock_unknown", _WARNING, checks.hours_needed, 0, "of 2 unknown",
        "missions by hour need a UTC clock and a zone or longitude",
        "give drive.recorded_at, and drive.zone",
        checks.hour_given_by,
        explains=("clock_unstated",),
    ),
    Check(
        "clock_unstated", _NOTE, checks.hours_unknown, 0, "of 2 unknown",
        "the hour of the drive is unknown",
        "for downloads by hour give drive.recorded_at, and drive.zone",
        lambda seen: f"for downloads by hour {checks.hour_given_by(seen)}",
    ),
)  # fmt: skip


# The checks on which fatal findings depend.
_DECISIVE = tuple(
    one
    for one in CHECKS
    if one.explains or one.code in {each.code for each in CHECKS if each.severity is _FATAL}
)


def fatal_findings(seen: Evidence) -> tuple[Finding, ...]:
    """Those of `diagnose` that are fatal, without the checks that these do not depend on."""
    return diagnose(seen, _DECISIVE).fatal


def diagnose(seen: Evidence, made: Sequence[Check] = CHECKS) -> Diagnosis:
    """Makes all checks, or some; consequences of a finding are left out."""
    found: list[Finding] = []
    explained: set[str] = set()
    untold: dict[str, str] = {}
    for check in made if len(seen) or checks.faulty(seen) or seen.bad else ():
        result = check.finding(seen)
        if result is None and check.needs:
            untold[check.code] = check.needs
        if isinstance(result, Finding) and check.code not in explained:
            found.append(result)
            explained |= {check.code, *check.explains}
    ranks = list(Severity)
    found.sort(key=lambda one: ranks.index(one.severity))
    return Diagnosis(len(seen), tuple(found), untold)
