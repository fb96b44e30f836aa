"""Drives with one lens darker, fogged or in the sun: how much of them is still localised.

    python -m engram_lab.checks.one_side_darker               # ENGRAM_DATA's clips, and the town
    python -m engram_lab.checks.one_side_darker --clips kitti,town --side-difference 0

Every other frame of KITTI 06, the first half of EuRoC V1_01 and a morning of hamlet are mapped as
they are; the rest, and another day of hamlet, are localised with one side changed. Disparities are
compared with those of the same corners in the unchanged pair: by their scatter in standard
deviations as told, 1 where they are honest and independent, and the share that is off by a pixel.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Landmarks, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.graph.model import Clock
from engram.localiser.localisation import LocalisationStatus
from engram.maps.map import Map
from engram.robot.mapping import map_drive
from engram.robot.settings import Settings
from engram.robot.starting import localise_drive
from engram.sequences.sequence import SequenceInfo
from engram_lab.checks.accuracy import EUROC, KITTI_06
from engram_lab.eyes import clip
from engram_lab.programs import Figure, command_line, report
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

Grey = NDArray[np.float32]
Change = Callable[[Grey, int], Grey]

CLIPS = ("kitti", "euroc", "town")
# Of hamlet: a clear morning, an overcast day, and the frames of each.
_MAPPED, _LIVE, _FRAMES = 0, 2, 80
# Every so many frames the disparities are compared.
_COMPARED = 5
# Of one side's pixels, grey levels: a darker sensor is no quieter.
_NOISE = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Some pairs as a drive: a `StereoSequence`."""

    info: SequenceInfo
    pairs: Sequence[StereoPair]
    skipped: int = 0

    @property
    def camera(self) -> StereoCamera:
        """Of all pairs."""
        return self.pairs[0].camera

    def __len__(self) -> int:
        return len(self.pairs)

    def __iter__(self) -> Iterator[StereoPair]:
        return iter(self.pairs)


def times(gain: float) -> Change:
    """All grey levels times a gain."""
    return lambda image, _: image * gain


def veiled(reach: float) -> Change:
    """The sun on one lens: half of the light is lost in a bright patch, of the image's width."""

    def change(image: Grey, _: int) -> Grey:
        height, width = image.shape
        y, x = np.mgrid[:height, :width].astype(np.float32)
        apart = np.hypot(x - 0.3 * width, y - 0.4 * height) / (reach * width)
        share = 0.6 * np.exp(-(apart**2))
        return np.asarray(image * (1 - share) + 200 * share, np.float32)

    return change


def vignetted(image: Grey, _: int) -> Grey:
    """The corners of one lens at 0.3 of the light."""
    height, width = image.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
    return np.asarray(image * (1 - 0.35 * (x**2 + y**2)), np.float32)


def fogged(image: Grey, _: int) -> Grey:
    """Half of the contrast, and of the same brightness."""
    return np.asarray(0.5 * image + 0.5 * image.mean(), np.float32)


def dirty(image: Grey, _: int) -> Grey:
    """A third of the contrast, and grey light from the dirt."""
    return np.asarray(0.35 * image + 60, np.float32)


def hunting(image: Grey, frame: int) -> Grey:
    """An exposure of its own that swings between 0.35 and 1."""
    return np.asarray(image * (0.675 + 0.325 * np.cos(0.6 * frame)), np.float32)


def filtered(image: Grey, _: int) -> Grey:
    """Another characteristic curve."""
    return np.asarray(255 * (image / 255) ** 1.8, np.float32)


RIGHT: Mapping[str, Change] = {
    "× 0.85": times(0.85), "× 0.7": times(0.7), "× 0.5": times(0.5), "× 0.35": times(0.35),
    "× 0.2": times(0.2), "× 0.1": times(0.1), "× 1.4": times(1.4), "fogged": fogged,
    "dirty": dirty, "vignetted": vignetted, "small veil": veiled(0.15), "large veil": veiled(0.4),
    "exposure hunts": hunting, "filtered": filtered,
}  # fmt: skip
LEFT: Mapping[str, Change] = {"× 0.35": times(0.35), "fogged": fogged, "large veil": veiled(0.4)}


def changed(pairs: Sequence[StereoPair], side: str, change: Change) -> list[StereoPair]:
    """The pairs with one side changed, with new noise, as 8 bits."""
    draws = np.random.default_rng(1)

    def image_of(image: NDArray[np.uint8], frame: int) -> NDArray[np.uint8]:
        other = change(image.astype(np.float32), frame)
        noisy = other + draws.normal(0, _NOISE, image.shape)
        return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)

    if side == "left":
        return [replace(pair, left=image_of(pair.left, k)) for k, pair in enumerate(pairs)]
    return [replace(pair, right=image_of(pair.right, k)) for k, pair in enumerate(pairs)]


def scatter(usual: Landmarks, found: Landmarks) -> tuple[float, float]:
    """Of disparities at the same corners: in standard deviations, and the share 1 px off."""
    rows = {tuple(pixel): row for row, pixel in enumerate(usual.pixels.tolist())}
    both = [
        (rows[pixel], row)
        for row, pixel in enumerate(map(tuple, found.pixels.tolist()))
        if pixel in rows
    ]
    if not both:
        return float("nan"), float("nan")
    before, after = np.array(both).T
    off = found.disparity_px[after] - usual.disparity_px[before]
    sigma = np.hypot(found.disparity_sigma_px[after], usual.disparity_sigma_px[before])
    return 1.4826 * float(np.median(np.abs(off / sigma))), float(np.mean(np.abs(off) > 1))


def clip_named(name: str) -> tuple[list[StereoPair], list[StereoPair]]:
    """Pairs that are mapped, and that are localised."""
    if name == "town":
        town = campaign_named("hamlet")
        first, live = (
            list(SimulatedDrive(town, one).frames(0, _FRAMES)) for one in (_MAPPED, _LIVE)
        )
        return first, live
    data = Path(os.environ["ENGRAM_DATA"])
    if name == "kitti":
        pairs = clip(data / KITTI_06)
        return pairs[::2], pairs[1::2]
    pairs = clip(data / EUROC)
    return pairs[: len(pairs) // 2], pairs[len(pairs) // 2 :]


def localised(map_path: Path, pairs: Sequence[StereoPair], settings: Settings) -> float:
    """Share of the frames with a fix."""
    drive = Pairs(SequenceInfo("changed", "pairs", Clock.RELATIVE, "changed"), pairs)
    with Map.open(map_path) as opened:
        found = localise_drive(opened, drive, settings)
    return float(np.mean([one.status is LocalisationStatus.LOCALISED for one in found]))


def figures(name: str, settings: Settings) -> Iterator[Figure]:
    """Four figures for each change of a clip."""
    mapped, live = clip_named(name)
    frontend = Frontend(replace(settings.frontend, thumbnails=False))
    usual = [frontend.extract(pair).landmarks for pair in live[::_COMPARED]]
    shown = {"as it is": live}
    shown |= {f"right {what}": changed(live, "right", one) for what, one in RIGHT.items()}
    shown |= {f"left {what}": changed(live, "left", one) for what, one in LEFT.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.engram"
        info = SequenceInfo("usual", "pairs", Clock.RELATIVE, "usual")
        map_drive(path, Pairs(info, mapped), settings)
        for what, pairs in shown.items():
            title = f"{name}, {what}"
            found = [frontend.extract(pair).landmarks for pair in pairs[::_COMPARED]]
            spread, off = np.nanmean(list(map(scatter, usual, found)), axis=0)
            yield Figure(f"{title}: localised", 100 * localised(path, pairs, settings), "%")
            yield Figure(f"{title}: landmarks", float(np.mean(list(map(len, found)))))
            yield Figure(f"{title}: scatter of disparities", float(spread), "σ")
            yield Figure(f"{title}: disparities 1 px off", 100 * float(off), "%")


def main() -> None:
    """Prints the figures of each clip."""
    parser = command_line(__doc__)
    parser.add_argument("--clips", default=",".join(CLIPS), help="of " + ", ".join(CLIPS))
    usual = FrontendConfig().side_difference
    parser.add_argument("--side-difference", type=float, default=usual, help="0: search as it was")
    asked = parser.parse_args()
    settings = Settings()
    frontend = replace(settings.frontend, side_difference=asked.side_difference)
    settings = replace(settings, frontend=frontend)
    for name in asked.clips.split(","):
        report(figures(name, settings), asked.json, name)


if __name__ == "__main__":
    main()
