"""Injected faults: each a small class with a strength, applied to the frames of a drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One frame that a robot is shown.

    Attributes:
        frame: number of the frame of the drive where the robot is at this moment.
        pair: what it sees, under the stamp that it is told.
    """

    frame: int
    pair: StereoPair


class Fault(Protocol):
    """Something that goes wrong from a frame of a drive on.

    Attributes:
        name: key in `FAULTS`.
        unit: of the strength.
        weakest, strongest: between which strengths are drawn, log-uniformly.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def unit(self) -> str: ...  # noqa: D102
    @property
    def weakest(self) -> float: ...  # noqa: D102
    @property
    def strongest(self) -> float: ...  # noqa: D102

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """The drive with the fault.

        Args:
            pairs: its frames.
            strength: in `unit`.
            start: number of the first frame that it concerns.
            rng: of what is random in it.
        """
        ...


def undisturbed(pairs: Sequence[StereoPair]) -> list[Shown]:
    """The drive as it is."""
    return [Shown(k, pair) for k, pair in enumerate(pairs)]


@dataclass(frozen=True, slots=True)
class Stall:
    """The camera shows nothing for a while."""

    name: str = "stall"
    unit: str = "s"
    weakest: float = 0.3
    strongest: float = 4.0

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        del rng
        until_ns = pairs[start].stamp_ns + strength * 1e9
        return [
            one for one in undisturbed(pairs) if one.frame < start or one.pair.stamp_ns >= until_ns
        ]


@dataclass(frozen=True, slots=True)
class Frozen:
    """One or both cameras repeat an image under new stamps."""

    sides: tuple[str, ...] = ("left", "right")
    name: str = "frozen stream"
    unit: str = "frames"
    weakest: float = 1.0
    strongest: float = 30.0

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        del rng
        old = {side: getattr(pairs[start - 1], side) for side in self.sides}
        held = range(start, start + round(strength))
        return [
            Shown(k, replace(pair, **old) if k in held else pair) for k, pair in enumerate(pairs)
        ]


@dataclass(frozen=True, slots=True)
class Some:
    """Some frames, at random, are dropped, shown twice, or shown one too late.

    Attributes:
        how: "dropped", "duplicated" (a second time, under a stamp a little later), "reordered"
            (after the next one, so that stamps run backwards).
    """

    how: str
    name: str
    unit: str = "of the frames"
    weakest: float = 0.02
    strongest: float = 0.5

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        shown: list[Shown] = []
        late: Shown | None = None
        for one in undisturbed(pairs):
            hit = one.frame >= start and late is None and rng.random() < strength
            if hit and self.how == "dropped":
                continue
            if hit and self.how == "reordered":
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


@dataclass(frozen=True, slots=True)
class ClockStep:
    """The clock is set forwards or back."""

    sign: int
    name: str
    unit: str = "s"
    weakest: float = 1.0
    strongest: float = 20_000.0

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        del rng
        step_ns = self.sign * round(strength * 1e9)
        return [
            Shown(k, replace(pair, stamp_ns=pair.stamp_ns + step_ns) if k >= start else pair)
            for k, pair in enumerate(pairs)
        ]


@dataclass(frozen=True, slots=True)
class LateSide:
    """The right image is that of some frames before."""

    name: str = "desynchronised pairs"
    unit: str = "frames"
    weakest: float = 1.0
    strongest: float = 4.0

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        del rng
        late = round(strength)
        return [
            Shown(k, replace(pair, right=pairs[k - late].right) if k >= max(start, late) else pair)
            for k, pair in enumerate(pairs)
        ]


@dataclass(frozen=True, slots=True)
class Changed:
    """Every pair from the start on, for so many frames, is changed by a function.

    Attributes:
        change: (pair, strength, share of the way through the fault 0…1, rng) → pair.
        frames: how long it lasts; None to the end.
    """

    name: str
    unit: str
    weakest: float
    strongest: float
    change: Callable[[StereoPair, float, float, np.random.Generator], StereoPair]
    frames: int | None = None

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        stop = len(pairs) if self.frames is None else min(start + self.frames, len(pairs))
        return [
            Shown(
                k,
                self.change(pair, strength, (k - start + 1) / (stop - start), rng)
                if start <= k < stop
                else pair,
            )
            for k, pair in enumerate(pairs)
        ]


@dataclass(frozen=True, slots=True)
class Blackout:
    """Both images are black for some frames."""

    name: str = "blackout"
    unit: str = "frames"
    weakest: float = 1.0
    strongest: float = 40.0

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        del rng
        dark = range(start, start + round(strength))
        return [
            Shown(k, on_both(pair, np.zeros_like) if k in dark else pair)
            for k, pair in enumerate(pairs)
        ]


@dataclass(frozen=True, slots=True)
class Kidnapped:
    """The robot is carried on along the route, unseen, and its stamps continue."""

    name: str = "kidnapped"
    unit: str = "frames"
    weakest: float = 10.0
    strongest: float = 60.0

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        del rng
        carried = round(strength)
        behind = range(start + carried, len(pairs))
        return [
            *undisturbed(pairs[:start]),
            *(Shown(k, replace(pairs[k], stamp_ns=pairs[k - carried].stamp_ns)) for k in behind),
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


def with_drops(pair: StereoPair, drops: float, rng: np.random.Generator) -> StereoPair:
    """Drops on both lenses: blurred discs, in other places on each."""

    def wet(image: Image) -> Image:
        height, width = image.shape
        mask = np.zeros(image.shape, np.float32)
        for _ in range(round(drops)):
            centre = (int(rng.integers(width)), int(rng.integers(height)))
            cv2.circle(mask, centre, int(rng.integers(8, 30)), 1.0, -1)
        soft = cv2.GaussianBlur(mask, (0, 0), 3.0)
        through = cv2.blur(image, (27, 27)).astype(np.float32)
        return np.asarray(image * (1 - soft) + through * soft, np.uint8)

    return on_both(pair, wet)


def with_car(pair: StereoPair, share: float, rng: np.random.Generator) -> StereoPair:
    """A textured car that keeps its distance ahead and fills a share of the image.

    Its texture is the same in every frame, so that odometry sees a robot at rest in front of it.
    """
    del rng
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


@dataclass(frozen=True, slots=True)
class FixedPattern:
    """Part of both images shows something that moves with the camera, from the first frame on.

    Attributes:
        side: of the image that it reaches in from: "bottom", "top", "left" or "right".
        depth_m: how far it is from the camera.
        contrast: of its texture; 1 is from 20 to 200 grey levels.
    """

    name: str = "fixed pattern"
    unit: str = "of the image"
    weakest: float = 0.1
    strongest: float = 0.6
    side: str | None = None
    depth_m: float | None = None
    contrast: float | None = None

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`; what is None is drawn."""
        del start
        camera = pairs[0].camera
        side = self.side or str(rng.choice(["bottom", "top", "left", "right"]))
        depth_m = self.depth_m or float(np.exp(rng.uniform(np.log(1.0), np.log(6.0))))
        contrast = self.contrast or float(rng.uniform(0.25, 1.0))
        shift = max(1, round(camera.focal_baseline / depth_m))
        noise = rng.integers(0, 256, (camera.height, camera.width + shift)).astype(np.uint8)
        smooth = cv2.GaussianBlur(noise, (0, 0), 2.0).astype(np.float32)
        spread = (smooth - smooth.min()) / max(float(np.ptp(smooth)), 1.0)
        texture = np.asarray(90 + contrast * (180 * spread - 90), np.uint8)
        where = reaching_in(camera.height, camera.width, side, strength)

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


@dataclass(frozen=True, slots=True)
class NeverMoved:
    """Both cameras repeat their first image, under new stamps, from the first frame on.

    Attributes:
        burnt_in: whether the driver writes the time into each image.
    """

    name: str = "frozen from the start"
    unit: str = "frames"
    weakest: float = 30.0
    strongest: float = 100.0
    burnt_in: bool = False

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        del start, rng
        first, shown = pairs[0], []
        for k, pair in enumerate(pairs[: round(strength)]):
            old = replace(pair, left=first.left, right=first.right)
            if self.burnt_in:
                old = on_both(old, partial(written, text=f"{k:06d}"))
            shown.append(Shown(k, old))
        return shown + undisturbed(pairs)[round(strength) :]


def written(image: Image, text: str) -> Image:
    """With a text near the upper left corner."""
    height = max(image.shape[0] // 20, 8)
    return np.asarray(
        cv2.putText(image.copy(), text, (8, height + 8), 0, height / 22, 255, 1), np.uint8
    )


@dataclass(frozen=True, slots=True)
class HuntingExposure:
    """Exposure that overshoots up and down for the rest of the drive, the sides not quite alike."""

    name: str = "exposure that hunts"
    unit: str = "times"
    weakest: float = 1.3
    strongest: float = 3.0
    frames: float = 7.0
    apart: float = 1.2

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        phase = rng.uniform(0, 2 * np.pi)
        shown = undisturbed(pairs)
        for k in range(start, len(pairs)):
            gain = strength ** np.sin(phase + 2 * np.pi * k / self.frames)
            bright = brightened(pairs[k].left, gain), brightened(pairs[k].right, gain / self.apart)
            shown[k] = Shown(k, replace(pairs[k], left=bright[0], right=bright[1]))
        return shown


@dataclass(frozen=True, slots=True)
class WrongStamps:
    """A few frames carry a stamp that is far off; those after them are right again."""

    name: str = "wrong stamps"
    unit: str = "s"
    weakest: float = 0.5
    strongest: float = 3600.0

    def apply(
        self, pairs: Sequence[StereoPair], strength: float, start: int, rng: np.random.Generator
    ) -> list[Shown]:
        """See `Fault`."""
        off_ns = int(rng.choice([-1, 1])) * round(strength * 1e9)
        few = range(start, start + int(rng.integers(1, 4)))
        zero = bool(rng.random() < 0.3)
        return [
            Shown(k, replace(pair, stamp_ns=0 if zero else pair.stamp_ns + off_ns))
            if k in few
            else Shown(k, pair)
            for k, pair in enumerate(pairs)
        ]


FAULTS: dict[str, Fault] = {
    one.name: one
    for one in (
        Stall(),
        Frozen(),
        Frozen(("right",), "right side frozen"),
        Some("dropped", "dropped frames"),
        Some("duplicated", "duplicated frames"),
        Some("reordered", "reordered frames"),
        ClockStep(1, "clock set forwards"),
        ClockStep(-1, "clock set back"),
        LateSide(),
        Changed("swapped sides", "", 1, 1, lambda pair, *_: exchanged(pair)),
        Changed(
            "growing decalibration", "px", 0.5, 6.0,
            lambda pair, px, share, _: replace(
                pair, right=lowered(pair.right, px * share, 0.003 * px * share)
            ),
        ),
        Changed(
            "exposure jump", "times", 1.5, 8.0,
            lambda pair, gain, *_: on_both(pair, lambda image: brightened(image, gain)),
            10,
        ),
        Changed(
            "exposure drop", "times", 1.5, 20.0,
            lambda pair, gain, *_: on_both(pair, lambda image: brightened(image, 1 / gain)),
            10,
        ),
        Blackout(),
        Changed("lens drops", "drops", 10, 300, lambda pair, n, _, rng: with_drops(pair, n, rng)),
        Changed("car ahead", "of the image", 0.1, 0.7,
                lambda pair, share, _, rng: with_car(pair, share, rng), 40),
        Kidnapped(),
        FixedPattern(),
        NeverMoved(),
        NeverMoved("frozen with a burnt-in time", burnt_in=True),
        Changed(
            "right side darker", "times", 1.2, 3.0,
            lambda pair, gain, *_: replace(pair, right=brightened(pair.right, 1 / gain)),
        ),
        HuntingExposure(),
        WrongStamps(),
    )
}  # fmt: skip

# Faults that are there from the first frame on, whatever the start.
FROM_THE_FIRST = frozenset(
    {"fixed pattern", "frozen from the start", "frozen with a burnt-in time"}
)
