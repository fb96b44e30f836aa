"""What the doctor measures: evidence in, one number out."""

from __future__ import annotations

import math
from itertools import compress, pairwise

import numpy as np
from numpy.typing import NDArray

from engram.doctor.examination import Alignment, Array, Evidence, Look, align, rows_off
from engram.frontend.frame import FrameStatus
from engram.geometry.se3 import SE3
from engram.graph.clock import known_zone
from engram.graph.model import Clock

_MOVING_M = 0.02
# A repeated image without contrast is darkness, not an old picture.
_CONTRAST = 4.0
# So many equal pairs are no robot at rest before a camera without noise.
_LONG = 30
# Steps that turn by more than odometry's noise.
_TURNING_RAD = math.radians(0.3)
# Ways are compared over stretches of this length, metres, and at least so many of them.
_WAY_M = 2.0
_LEAST_WAYS = 3
# Their median counts beyond so many of its standard errors by the spread of the ways, and beyond
# this share of what odometry claims of one way.
_SIGNIFICANT_SCALE, _COMMON = 3.0, 0.5
# In rain all ways are too short, by up to a fifth: that counts only where odometry claims to know
# them better than this share.
_SURE = 0.065
# Standard error of the median of n normal values: times their median absolute deviation, over √n.
_OF_MEDIAN = 1.4826 * math.sqrt(math.pi / 2)


def without_odometry(seen: Evidence) -> float | None:
    """Share of frames without odometry."""
    if len(seen) < seen.config.least_frames:
        return None
    return 1.0 - float(np.mean(seen.odometry))


def frozen_frames(seen: Evidence) -> float | None:
    """Most images in a row that repeat the one before.

    Equal pairs while the robot rests, or before it has moved, say nothing: a simulated camera may
    have no noise. Where odometry last failed, or wheels turn, the robot counts as moving.
    """
    if not seen.looks or len(seen.looks) != len(seen):
        return None
    longest = [0, 0]
    run, moving = [0, 0], False
    for number, look in enumerate(seen.looks):
        step, told = seen.moved[number], seen.outside[number]
        still = all(look.repeats)
        turns = told is not None and told.distance_m > _MOVING_M
        if not any(look.repeats):
            moving = number > 0 if step is None else step.distance_m > _MOVING_M
        for side in (0, 1):
            old = _repeats(look, side) or (turns and _frozen(seen, number))
            run[side] = run[side] + 1 if old else 0
            if not still or moving or turns or run[side] >= _LONG:
                longest[side] = max(longest[side], run[side])
    return float(max(longest))


def scale_off(seen: Evidence) -> float | None:
    """How far odometry's scale is from that of motion from outside, as a share.

    None where odometry is too unsure to decide: in rain its steps are uncertain, and too short.
    """
    ways: list[tuple[float, float]] = []
    nowhere = SE3.identity(), SE3.identity(), 0.0
    measured, outside, variance = nowhere
    for step, sigma_m, told in zip(seen.moved, seen.sigma_m, seen.outside, strict=True):
        if step is None or told is None:
            measured, outside, variance = nowhere
            continue
        measured, outside, variance = measured @ step, outside @ told, variance + sigma_m**2
        if outside.distance_m >= _WAY_M:
            way_m = outside.distance_m
            ways.append((measured.distance_m / way_m, math.sqrt(variance) / way_m))
            measured, outside, variance = nowhere
    if len(ways) < _LEAST_WAYS:
        return None
    ratios, sigmas = np.array(ways).T
    ratio, sigma = float(np.median(ratios)), float(np.median(sigmas))
    if ratio < 1 and sigma > _SURE:
        return None
    spread = _OF_MEDIAN * float(np.median(np.abs(ratios - ratio))) / math.sqrt(len(ways))
    unsure, off = max(_SIGNIFICANT_SCALE * spread, _COMMON * sigma), abs(ratio - 1)
    return off if max(off, seen.config.scale) > unsure else None


def turn_ratio(seen: Evidence) -> float | None:
    """The turn by gyroscope or wheels over that which odometry sees; the median where it turns.

    Axes do not matter to it, so that a mounting that is not known does no harm.
    """
    ratios = [
        turned_rad / step.angle_rad
        for step, turned_rad in zip(seen.moved, seen.turned_rad, strict=False)
        if step is not None and turned_rad is not None and step.angle_rad > _TURNING_RAD
    ]
    return float(np.median(ratios)) if len(ratios) >= seen.config.least_frames else None


def _repeats(look: Look, side: int) -> bool:
    return look.repeats[side] and look.contrast[side] > _CONTRAST


def _frozen(seen: Evidence, number: int) -> bool:
    return seen.statuses[number] is FrameStatus.FROZEN


def px_per_deg(seen: Evidence) -> float | None:
    """Pixels per degree at the middle of the image."""
    return None if seen.camera is None else math.radians(seen.camera.fx)


def other_size(seen: Evidence) -> float | None:
    """How far off the middle the principal point is, in half images; 0 where the axes disagree.

    Images that were resized without their calibration shift it alike on both axes; a lens or a
    strip cut from the image shifts it on one.
    """
    if seen.camera is None:
        return None
    across = 2 * seen.camera.cx / (seen.camera.width - 1) - 1
    down = 2 * seen.camera.cy / (seen.camera.height - 1) - 1
    return min(abs(across), abs(down)) if across * down > 0 else 0.0


def disparity_px(seen: Evidence) -> float | None:
    """Median disparity of the landmarks."""
    known = [one for one in seen.disparity_px if one > 0]
    return float(np.median(known)) if len(known) >= seen.config.least_frames else None


def focal_too_long(seen: Evidence) -> float | None:
    """By what share the focal length is too long, by a map."""
    return _above(seen.rematched.focal_factor)


def focal_too_short(seen: Evidence) -> float | None:
    """By what share it is too short."""
    return _below(seen.rematched.focal_factor)


def baseline_too_long(seen: Evidence) -> float | None:
    """By what share the baseline is too long, by a map."""
    return _above(seen.rematched.baseline_factor)


def baseline_too_short(seen: Evidence) -> float | None:
    """By what share it is too short."""
    return _below(seen.rematched.baseline_factor)


def _above(factor: float | None) -> float | None:
    return None if factor is None else max(factor - 1, 0.0)


def _below(factor: float | None) -> float | None:
    return None if factor is None else max(1 - factor, 0.0)


def saturated(seen: Evidence) -> float | None:
    """Share of frames too much of which is white."""
    return _spoilt([look.saturated > seen.config.saturated for look in seen.looks])


def black(seen: Evidence) -> float | None:
    """Share of frames too much of which is black."""
    return _spoilt([look.black > seen.config.black for look in seen.looks])


def exposure_step(seen: Evidence) -> float | None:
    """Largest change of brightness from one frame to the next, in factors of two."""
    if len(seen.looks) < seen.config.least_frames or len(seen.looks) != len(seen):
        return None
    bright = np.log2([max(look.brightness[0], 1.0) for look in seen.looks])
    steps = np.abs(np.diff(bright))[~np.array(seen.first[1:], np.bool_)]
    return float(steps.max()) if len(steps) else None


def exposure_difference(seen: Evidence) -> float | None:
    """Difference of brightness between left and right, in factors of two: the median."""
    if len(seen.looks) < seen.config.least_frames:
        return None
    bright = np.log2(np.maximum([look.brightness for look in seen.looks], 1.0))
    return float(np.median(np.abs(bright[:, 0] - bright[:, 1])))


def sharpness(seen: Evidence) -> float | None:
    """Mean square of the second difference along rows over the variance: the median."""
    return float(np.median(seen.sharpness)) if len(seen.sharpness) >= 3 else None


def bits(seen: Evidence) -> float | None:
    """Bits of the brightest pixel of 16-bit images."""
    return None if seen.facts.bits is None else float(seen.facts.bits)


def fixed_share(seen: Evidence) -> float | None:
    """Share of the image that moves with the camera."""
    return seen.fixed_share if len(seen) >= seen.config.least_frames else None


def doubted(seen: Evidence) -> float | None:
    """Share of frames that leave open whether the robot or part of the image stood still."""
    return seen.doubted / len(seen) if len(seen) >= seen.config.least_frames else None


def _spoilt(frames: list[bool]) -> float | None:
    return float(np.mean(frames)) if frames else None


def bad_pairs(seen: Evidence) -> float | None:
    """Pairs that were left out because an image cannot be used."""
    return float(len(seen.bad))


# Units in which somebody may have counted frames, ns.
_UNITS_NS = (1, 1_000, 1_000_000, 1_000_000_000)
# Intervals on either side with which one is compared.
_AROUND = 5


def faulty_share(seen: Evidence) -> float | None:
    """Share of the drive's frames that its reader left out for a wrong stamp."""
    return seen.read.faulty_share


def faulty(seen: Evidence) -> float | None:
    """Frames left out as they are stamped before, or far after, their neighbours."""
    return float(seen.read.faulty + seen.taken.faulty)


def repeated(seen: Evidence) -> float | None:
    """Frames with the stamp of the frame before."""
    return float(seen.read.repeated + seen.taken.repeated)


def steps(seen: Evidence) -> float | None:
    """How often the clock was set; not forwards, which cannot be distinguished from a pause."""
    shifts_ns = [0, *(one.shift_ns for one in (*seen.read.steps, *seen.taken.steps))]
    return float(sum(a != b for a, b in pairwise(shifts_ns)))


def counted(seen: Evidence) -> float | None:
    """Share of frames whose stamp is their number, in ns, µs, ms or s."""
    if seen.facts.step != 1 or len(seen) < seen.config.least_frames:
        return None
    stamps = np.array(seen.stamps_ns, np.int64)
    most = 0.0
    for unit_ns in _UNITS_NS:
        whole = (stamps % unit_ns == 0) & (stamps // unit_ns <= 10 * len(stamps))
        steps = np.diff(stamps) == unit_ns
        most = max(most, float(min(whole.mean(), steps.mean())))
    return most


def jump_s(seen: Evidence) -> float | None:
    """The longest interval, if it is not as long as others: stamps in another unit do not jump."""
    intervals_s = seen.intervals_s
    if not len(intervals_s):
        return None
    longest_s = float(intervals_s.max())
    return longest_s if longest_s > seen.config.gap_ratio * np.median(intervals_s) else 0.0


def gap_ratio(seen: Evidence) -> float | None:
    """The longest interval, in the median of those around it; steps of the clock do not count."""
    intervals_s = seen.intervals_s
    intervals_s = intervals_s[intervals_s <= seen.config.jump_s]
    if len(intervals_s) < seen.config.least_frames:
        return None
    return float((intervals_s / _usual(intervals_s)).max())


def rate_hz(seen: Evidence) -> float | None:
    """Frames per second."""
    intervals_s = seen.intervals_s
    if len(intervals_s) < seen.config.least_frames:
        return None
    return float(1 / max(float(np.median(intervals_s)), 1e-9))


def hours_unknown(seen: Evidence) -> float | None:
    """How much is unknown of two: that the stamps are UTC, and where on earth that was."""
    facts = seen.facts
    nowhere = facts.longitude_deg is None and known_zone(facts.zone) is None
    return float((facts.clock is not Clock.UTC) + nowhere)


def hour_given_by(seen: Evidence) -> str:
    """The options that determine the hour of the drive."""
    facts = seen.facts
    nowhere = facts.zone is None and facts.longitude_deg is None
    asked = ["drive.recorded_at"] if facts.clock is not Clock.UTC else []
    return "give " + " and ".join(asked + ["drive.zone"] * nowhere)


def hours_needed(seen: Evidence) -> float | None:
    """The same, where missions by hour need it."""
    return hours_unknown(seen) if seen.facts.by_hour else None


def _usual(intervals_s: Array) -> Array:
    padded = np.pad(intervals_s, _AROUND, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1)
    return np.maximum(np.median(around, axis=1), 1e-9)


# Pairs whose alignment is worked out: more add nothing.
_ALIGNED = 24
_LEAST_PAIRS = 4
# Disparities below this have no sign.
_NO_DISPARITY_PX = 1.0
# The scene reaches as far up, or down, as this share of the matches there; and the fewest of them.
_REACH = 0.9
_LEAST_REACHING = 20
_LEAST_CLEAR = 80
# Most frames that a side may be late, by how much the sides' changes then correlate better than
# at once, and the fewest steps of a moving robot that tell.
_MOST_LATE = 5
_CLEARER = 0.25
_LEAST_STEPS = 15
_AT_REST_M = 0.02
# Added to the spread of the rows, grey levels: in the dark there is only noise.
_LEAST_SPREAD = 1.0
# A pair shows a way forwards beyond this many standard deviations.
_SIGNIFICANT_WAY = 4.0


def negative_share(seen: Evidence) -> float | None:
    """Share of matches that lie further right in the right image."""
    disparity = _agreeing(seen)[:, 0]
    clear = disparity[np.abs(disparity) > _NO_DISPARITY_PX]
    return float((clear < 0).mean()) if len(clear) >= _LEAST_CLEAR else None


def upright(seen: Evidence) -> float | None:
    """Logarithm of how much further up than down the scene reaches, from the camera's axis.

    The ground ends it below, in all light; above nothing does.
    """
    disparity, down = _agreeing(seen).T
    # In baselines; far things count less, as their distance is uncertain.
    reach = down / (np.abs(disparity) + _NO_DISPARITY_PX)
    above, below = -reach[down < 0], reach[down > 0]
    if min(len(above), len(below)) < _LEAST_REACHING:
        return None
    return float(np.log(np.quantile(above, _REACH) / np.quantile(below, _REACH)))


def swapped(seen: Evidence) -> float | None:
    """The share of negative disparities, if the images are not upside down."""
    return 0.0 if (upright(seen) or 0) < 0 else negative_share(seen)


def rotated(seen: Evidence) -> float | None:
    """The share of negative disparities, if the images are upside down."""
    return negative_share(seen) if (upright(seen) or 0) < 0 else 0.0


def upside_down(seen: Evidence) -> float | None:
    """How upright the images are, if left and right are in their places."""
    negative = negative_share(seen)
    if negative is None or negative > seen.config.negative_share:
        return None
    return upright(seen)


def frames_late(seen: Evidence) -> float | None:
    """Frames by which one side shows what the other has shown before; 0 if both are at once.

    What a robot that drives sees in a row of the image changes in both sides alike, whatever the
    disparities: the changes correlate best at the lag between the sides. In rain and in the dark,
    too, where few corners match. Not at rest, nor while a camera looks sideways: there one side
    comes to where the other was a moment before.
    """
    if not seen.looks or len(seen.looks) != len(seen):
        return None
    rests = seen.moved_m < _AT_REST_M
    if sum(map(_aside, compress(seen.moved, ~rests))) > 0.5 * np.count_nonzero(~rests):
        return None
    change = np.diff([_unexposed(one.rows) for one in seen.looks], axis=0)
    change[np.array(seen.first[1:], np.bool_) | rests[1:]] = 0
    if np.count_nonzero(change.any(axis=(1, 2))) < _LEAST_STEPS:
        return None
    left, right = change.swapaxes(0, 1)
    late = [_alike(left, right, lag) for lag in range(_MOST_LATE + 1)]
    early = [_alike(right, left, lag) for lag in range(_MOST_LATE + 1)]
    alike = np.maximum(late, early)
    return float(alike.argmax()) if alike.max() > max(alike[0], 0) + _CLEARER else 0.0


def forward_m(seen: Evidence) -> float | None:
    """Distance between the instants of left and right: the median over pairs that moved."""
    ways = [
        abs(one.forward_m) if abs(one.forward_m) > _SIGNIFICANT_WAY * one.sigma_m else 0.0
        for one in _alignments(seen)
    ]
    return float(np.median(ways)) if len(ways) >= _LEAST_PAIRS else None


def row_jump_px(seen: Evidence) -> float | None:
    """Scatter of the vertical offset from pair to pair: a pitch between two instants."""
    offsets = np.array([one.offset_px for one in _alignments(seen)])
    if len(offsets) < _LEAST_PAIRS:
        return None
    return float(np.median(np.abs(offsets - np.median(offsets))))


def row_offset_px(seen: Evidence) -> float | None:
    """Vertical offset shared by all pairs; undetermined if pairs were taken at two instants.

    The larger of what a shift, a roll and a scale explain, and of what lies in parts of the image.
    """
    jump = row_jump_px(seen)
    if seen.camera is None or jump is None or jump > seen.config.row_jump_px:
        return None
    whole = float(np.median([one.rms_px for one in _alignments(seen)]))
    return max(whole, rows_off([one for _, one in seen.matches], seen.camera) or 0.0)


def _aside(moved: SE3 | None) -> bool:
    return moved is not None and bool(abs(moved.translation[0]) > abs(moved.translation[2]))


def _unexposed(rows: NDArray[np.float32]) -> Array:
    """Rows (2, R) of each side free of its exposure, which may change on its own."""
    spread = rows.std(axis=1, keepdims=True)
    return np.asarray((rows - rows.mean(axis=1, keepdims=True)) / (spread + _LEAST_SPREAD))


def _alike(ahead: Array, behind: Array, lag: int) -> float:
    """Correlation of the changes of one side with those of the other some frames later."""
    ahead, behind = ahead[: len(ahead) - lag], behind[lag:]
    size = float(np.linalg.norm(ahead) * np.linalg.norm(behind))
    return float((ahead * behind).sum()) / max(size, 1e-9)


def _agreeing(seen: Evidence) -> Array:
    """(M, 2) px: disparity and rows below the principal point, of matches that fit their pair."""
    middle = 0.0 if seen.camera is None else seen.camera.cy
    parts = [one.agreeing for one in _alignments(seen)]
    both = [np.column_stack([part.shift[:, 0], part.pixels[:, 1] - middle]) for part in parts]
    return np.concatenate([np.zeros((0, 2)), *both])


def _alignments(seen: Evidence) -> list[Alignment]:
    """Of some pairs, spread over all; worked out once."""
    if seen.camera is None or not seen.matches:
        return []
    if seen.alignments is None:
        at = np.unique(np.linspace(0, len(seen.matches) - 1, _ALIGNED).round().astype(int))
        tried = [align(seen.matches[k][1], seen.camera, seed=int(k)) for k in at]
        seen.alignments = [one for one in tried if one is not None]
    return seen.alignments
