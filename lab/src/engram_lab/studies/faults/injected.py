"""Injected faults: each a small class with a strength, applied to the frames of a drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend import StereoPair

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
    """The robot is carried on along the route, unseen, and its stamps go on."""

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
    )
}  # fmt: skip
