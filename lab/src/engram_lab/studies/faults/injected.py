"""Injected faults: each a function of a strength, applied to the frames of a drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair
from engram_lab.town.glass import OPEN_GLASS, Glass, Pane, WetLens

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One frame that a robot is shown."""

    frame: int
    pair: StereoPair


Pairs: TypeAlias = Sequence[StereoPair]
Random: TypeAlias = np.random.Generator
# Frames of a drive, strength, number of the first frame concerned, what is random → what is shown.
Apply: TypeAlias = Callable[[Pairs, float, int, Random], list[Shown]]


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that goes wrong from a frame of a drive on.

    Attributes:
        weakest, strongest: between which strengths are drawn, log-uniformly, in `unit`.
        from_the_first: whether it is there from the first frame on, whatever the start.
    """

    name: str
    unit: str
    weakest: float
    strongest: float
    apply: Apply
    from_the_first: bool = False


def undisturbed(pairs: Pairs) -> list[Shown]:
    """The drive as it is."""
    return [Shown(k, pair) for k, pair in enumerate(pairs)]


def stalled(pairs: Pairs, seconds: float, start: int, _: Random) -> list[Shown]:
    """The camera shows nothing for a while."""
    until_ns = pairs[start].stamp_ns + seconds * 1e9
    return [one for one in undisturbed(pairs) if one.frame < start or one.pair.stamp_ns >= until_ns]


def frozen(
    pairs: Pairs, frames: float, start: int, _: Random, sides: Sequence[str] = ("left", "right")
) -> list[Shown]:
    """One or both cameras repeat an image under new stamps."""
    old = {side: getattr(pairs[start - 1], side) for side in sides}
    held = range(start, start + round(frames))
    return [Shown(k, replace(pair, **old) if k in held else pair) for k, pair in enumerate(pairs)]


def irregular(pairs: Pairs, share: float, start: int, rng: Random, how: str) -> list[Shown]:
    """Frames, drawn at random, that are dropped, shown twice, or shown one too late.

    `how`: "dropped"; "duplicated", a second time, under a stamp a little later; "reordered", after
    the next one, so that stamps run backwards.
    """
    shown: list[Shown] = []
    late: Shown | None = None
    for one in undisturbed(pairs):
        hit = one.frame >= start and late is None and rng.random() < share
        if hit and how == "dropped":
            continue
        if hit and how == "reordered":
            late = one
            continue
        shown.append(one)
        if hit:
            again = replace(one.pair, stamp_ns=one.pair.stamp_ns + 40_000_000)
            shown.append(Shown(one.frame, again))
        if late is not None:
            shown.append(late)
            late = None
    return shown


def clock_set(pairs: Pairs, seconds: float, start: int, _: Random, sign: int = 1) -> list[Shown]:
    """The clock is set forwards or back."""
    step_ns = sign * round(seconds * 1e9)
    return [
        Shown(k, replace(pair, stamp_ns=pair.stamp_ns + step_ns) if k >= start else pair)
        for k, pair in enumerate(pairs)
    ]


def late_side(pairs: Pairs, frames: float, start: int, _: Random) -> list[Shown]:
    """The right image is that of some frames before."""
    late = round(frames)
    return [
        Shown(k, replace(pair, right=pairs[k - late].right) if k >= max(start, late) else pair)
        for k, pair in enumerate(pairs)
    ]


# A pair, strength, share of the fault's duration 0…1, what is random → the pair as it is shown.
Change: TypeAlias = Callable[[StereoPair, float, float, Random], StereoPair]


def changed(change: Change, frames: int | None = None) -> Apply:
    """Every pair from the start on is changed, for so many frames; None to the end."""

    def apply(pairs: Pairs, strength: float, start: int, rng: Random) -> list[Shown]:
        stop = len(pairs) if frames is None else min(start + frames, len(pairs))
        shown = undisturbed(pairs)
        for k in range(start, stop):
            pair = change(pairs[k], strength, (k - start + 1) / (stop - start), rng)
            shown[k] = Shown(k, pair)
        return shown

    return apply


def blackout(pairs: Pairs, frames: float, start: int, _: Random) -> list[Shown]:
    """Both images are black for some frames."""
    dark = range(start, start + round(frames))
    return [
        Shown(k, on_both(pair, np.zeros_like) if k in dark else pair)
        for k, pair in enumerate(pairs)
    ]


def kidnapped(pairs: Pairs, frames: float, start: int, _: Random) -> list[Shown]:
    """The robot is carried along the route, unseen, and its stamps continue."""
    carried = round(frames)
    after = range(start + carried, len(pairs))
    return [
        *undisturbed(pairs[:start]),
        *(Shown(k, replace(pairs[k], stamp_ns=pairs[k - carried].stamp_ns)) for k in after),
    ]


def on_both(pair: StereoPair, change: Callable[[Image], Image]) -> StereoPair:
    """The pair with both images changed alike."""
    return replace(pair, left=change(pair.left), right=change(pair.right))


def exchanged(pair: StereoPair) -> StereoPair:
    """Left and right swapped."""
    return replace(pair, left=pair.right, right=pair.left)


def turned(image: Image) -> Image:
    """Turned by 180°."""
    return np.ascontiguousarray(image[::-1, ::-1])


def brightened(image: Image, gain: float) -> Image:
    """All grey levels times a gain."""
    return np.asarray(np.clip(image.astype(np.float32) * gain, 0, 255), np.uint8)


def blurred(image: Image, sigma_px: float) -> Image:
    """Out of focus."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8)


def lowered(image: Image, rows_px: float, turned_rad: float = 0.0) -> Image:
    """Moved down by some rows, and rolled about the middle."""
    height, width = image.shape
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), np.degrees(turned_rad), 1.0)
    matrix[1, 2] += rows_px
    border = cv2.BORDER_REPLICATE
    return np.asarray(cv2.warpAffine(image, matrix, (width, height), borderMode=border), np.uint8)


def halved(pair: StereoPair, factor: float) -> StereoPair:
    """A pair of a camera with fewer pixels."""
    camera = pair.camera
    size = (round(camera.width / factor), round(camera.height / factor))

    def smaller(image: Image) -> Image:
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    fewer = replace(
        camera,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=(camera.cx + 0.5) / factor - 0.5,
        cy=(camera.cy + 0.5) / factor - 0.5,
        width=size[0],
        height=size[1],
    )
    return replace(on_both(pair, smaller), camera=fewer)


_RAINED_S, _SPEED_M_S = 120.0, 5.0  # for how long it has rained, and a robot's speed


def rained_on(
    pairs: Pairs, rate_mm_h: float, start: int, rng: Random, glass: Glass = OPEN_GLASS
) -> list[Shown]:
    """Rain on the panes of both lenses, two minutes' worth of it by the first frame concerned."""
    camera, shown = pairs[0].camera, undisturbed(pairs)
    eyes = [WetLens(Pane(glass, camera, [int(rng.integers(2**31))]), camera) for _ in range(2)]
    seconds = _RAINED_S
    for k in range(start, len(pairs)):
        for eye in eyes:
            eye.pane.advance(rate_mm_h, _SPEED_M_S, seconds)
        sides = (pairs[k].left, pairs[k].right)
        left, right = (
            np.asarray(eye.through(side.astype(np.float32)), np.uint8)
            for eye, side in zip(eyes, sides, strict=True)
        )
        shown[k] = Shown(k, replace(pairs[k], left=left, right=right))
        following = pairs[min(k + 1, len(pairs) - 1)]
        seconds = 1e-9 * (following.stamp_ns - pairs[k].stamp_ns)
    return shown


def with_car(pair: StereoPair, share: float, *_: object) -> StereoPair:
    """A textured car that keeps its distance ahead and fills a share of the image.

    Its texture is the same in every frame, so that odometry sees a robot at rest in front of it.
    """
    height, width = pair.left.shape
    side = min(np.sqrt(share), 0.95)
    rows, columns = int(height * side), int(width * side)
    pattern = np.random.default_rng(7).integers(30, 220, (rows // 6 + 1, columns // 6 + 1))
    texture = cv2.resize(pattern.astype(np.uint8), (columns, rows), interpolation=cv2.INTER_CUBIC)
    top, first = height - rows, (width - columns) // 2
    disparity = min(round(pair.camera.focal_baseline / 8.0), first)
    images = []
    for image, at in ((pair.left, first), (pair.right, first - disparity)):
        painted = image.copy()
        painted[top:, at : at + columns] = texture
        images.append(painted)
    return replace(pair, left=images[0], right=images[1])


def fixed_pattern(
    pairs: Pairs,
    share: float,
    _: int,
    rng: Random,
    side: str | None = None,
    depth_m: float | None = None,
    contrast: float | None = None,
) -> list[Shown]:
    """Part of both images shows something that moves with the camera; what is None is drawn.

    Args:
        share: of the image that it covers.
        side: of the image that it reaches in from: "bottom", "top", "left" or "right".
        contrast: of its texture; 1 is from 20 to 200 grey levels.
    """
    camera = pairs[0].camera
    side = side or str(rng.choice(["bottom", "top", "left", "right"]))
    depth_m = depth_m or float(np.exp(rng.uniform(np.log(1.0), np.log(6.0))))
    contrast = contrast or float(rng.uniform(0.25, 1.0))
    shift = max(1, round(camera.focal_baseline / depth_m))
    noise = rng.integers(0, 256, (camera.height, camera.width + shift)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0).astype(np.float32)
    spread = (smooth - smooth.min()) / max(float(np.ptp(smooth)), 1.0)
    texture = np.asarray(90 + contrast * (180 * spread - 90), np.uint8)
    where = reaching_in(camera.height, camera.width, side, share)

    def painted(image: Image, first: int) -> Image:
        return np.where(where, texture[:, first : first + camera.width], image)

    return [
        Shown(k, replace(one, left=painted(one.left, 0), right=painted(one.right, shift)))
        for k, one in enumerate(pairs)
    ]


def reaching_in(height: int, width: int, side: str, share: float) -> NDArray[np.bool_]:
    """(height, width) bool: the part of an image that a thing covers from one side on."""
    rows, columns = np.indices((height, width))
    along = {
        "bottom": (height - 1 - rows) / height,
        "top": rows / height,
        "left": columns / width,
        "right": (width - 1 - columns) / width,
    }[side]
    return np.asarray(along < share, np.bool_)


def never_moved(
    pairs: Pairs, frames: float, _: int, __: Random, *, burnt_in: bool = False
) -> list[Shown]:
    """Both cameras repeat their first image; `burnt_in`: with the time written into each."""
    first, shown = pairs[0], undisturbed(pairs)
    for k, pair in enumerate(pairs[: round(frames)]):
        old = replace(pair, left=first.left, right=first.right)
        shown[k] = Shown(k, on_both(old, partial(written, text=f"{k:06d}")) if burnt_in else old)
    return shown


def written(image: Image, text: str) -> Image:
    """With a text near the upper left corner."""
    height = max(image.shape[0] // 20, 8)
    return np.asarray(
        cv2.putText(image.copy(), text, (8, height + 8), 0, height / 22, 255, 1), np.uint8
    )


_HUNTING_FRAMES, _SIDES_APART = 7.0, 1.2


def hunting_exposure(pairs: Pairs, strength: float, start: int, rng: Random) -> list[Shown]:
    """Exposure that overshoots up and down for the rest of the drive, the sides not quite alike."""
    phase = rng.uniform(0, 2 * np.pi)
    shown = undisturbed(pairs)
    for k in range(start, len(pairs)):
        gain = strength ** np.sin(phase + 2 * np.pi * k / _HUNTING_FRAMES)
        bright = brightened(pairs[k].left, gain), brightened(pairs[k].right, gain / _SIDES_APART)
        shown[k] = Shown(k, replace(pairs[k], left=bright[0], right=bright[1]))
    return shown


def wrong_stamps(pairs: Pairs, seconds: float, start: int, rng: Random) -> list[Shown]:
    """A few frames carry a stamp that is far off; those after them are right again."""
    off_ns = int(rng.choice([-1, 1])) * round(seconds * 1e9)
    few = range(start, start + int(rng.integers(1, 4)))
    zero = bool(rng.random() < 0.3)
    shown = undisturbed(pairs)
    for k in few:
        stamp_ns = 0 if zero else pairs[k].stamp_ns + off_ns
        shown[k] = Shown(k, replace(pairs[k], stamp_ns=stamp_ns))
    return shown


def _decalibrated(pair: StereoPair, px: float, share: float, _: Random) -> StereoPair:
    return replace(pair, right=lowered(pair.right, px * share, 0.003 * px * share))


def _brighter(pair: StereoPair, gain: float, *_: object) -> StereoPair:
    return on_both(pair, lambda image: brightened(image, gain))


def _darker(pair: StereoPair, gain: float, *_: object) -> StereoPair:
    return on_both(pair, lambda image: brightened(image, 1 / gain))


def _one_side_darker(pair: StereoPair, gain: float, *_: object) -> StereoPair:
    return replace(pair, right=brightened(pair.right, 1 / gain))


_SHARE = "of the frames"
FAULTS: dict[str, Fault] = {
    one.name: one
    for one in (
        Fault("stall", "s", 0.3, 4.0, stalled),
        Fault("frozen stream", "frames", 1, 30, frozen),
        Fault("right side frozen", "frames", 1, 30, partial(frozen, sides=("right",))),
        Fault("dropped frames", _SHARE, 0.02, 0.5, partial(irregular, how="dropped")),
        Fault("duplicated frames", _SHARE, 0.02, 0.5, partial(irregular, how="duplicated")),
        Fault("reordered frames", _SHARE, 0.02, 0.5, partial(irregular, how="reordered")),
        Fault("clock set forwards", "s", 1, 20_000, clock_set),
        Fault("clock set back", "s", 1, 20_000, partial(clock_set, sign=-1)),
        Fault("desynchronised pairs", "frames", 1, 4, late_side),
        Fault("swapped sides", "", 1, 1, changed(lambda pair, *_: exchanged(pair))),
        Fault("growing decalibration", "px", 0.5, 6.0, changed(_decalibrated)),
        Fault("exposure jump", "times", 1.5, 8.0, changed(_brighter, 10)),
        Fault("exposure drop", "times", 1.5, 20.0, changed(_darker, 10)),
        Fault("blackout", "frames", 1, 40, blackout),
        Fault("rain on the lens", "mm/h", 0.5, 25.0, rained_on),
        Fault(
            "rain on an unwiped pane", "mm/h", 0.5, 25.0,
            partial(rained_on, glass=Glass(distance_mm=40.0)),
        ),
        Fault(
            "rain and a wiper", "mm/h", 0.5, 25.0,
            partial(rained_on, glass=Glass(distance_mm=40.0, wiped_every_s=2.0)),
        ),
        Fault("rain under a hood", "mm/h", 0.5, 25.0, partial(rained_on, glass=Glass(hood=1.0))),
        Fault("car ahead", "of the image", 0.1, 0.7, changed(with_car, 40)),
        Fault("kidnapped", "frames", 10, 60, kidnapped),
        Fault("fixed pattern", "of the image", 0.1, 0.6, fixed_pattern, True),
        Fault("frozen from the start", "frames", 30, 100, never_moved, True),
        Fault(
            "frozen with a burnt-in time", "frames", 30, 100,
            partial(never_moved, burnt_in=True), True,
        ),
        Fault("right side darker", "times", 1.2, 3.0, changed(_one_side_darker)),
        Fault("exposure that hunts", "times", 1.3, 3.0, hunting_exposure),
        Fault("wrong stamps", "s", 0.5, 3600.0, wrong_stamps),
    )
}  # fmt: skip
