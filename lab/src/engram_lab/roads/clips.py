"""Rendered frames beside real ones: KITTI 06, and the town by the same camera.

    python -m engram_lab.roads.clips [--picture both.jpg]     # needs the clip under $ENGRAM_DATA

Corners, contrast, noise, spectrum and stereo matches of single pairs, and how matches fall off with
the distance between two views: each second frame as a map for the one some frames further on, by
OpenCV's SIFT. The town's road runs straight between houses there, as on the clip.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.sequences.opening import open_drive
from engram_lab.programs import Figure, command_line, report
from engram_lab.roads.matching import SIFT, map_frame, placed
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

# KITTI 06 from frame 0 to 50, and the mean way between two frames.
CLIP_FRAMES = 51
CLIP_SPACING_M = 1.197
_STEPS = (1, 2, 4, 6)
_RIGHT_M = 0.25
# Of `village`: a clear morning.
_SESSION, _FIRST_FRAME = 1, 60

Clip = Sequence[tuple[SE3, StereoPair]]


def load_clip() -> Clip:
    """KITTI 06, frames 0 to 50, with true poses.

    Raises:
        ConfigError: ``$ENGRAM_DATA`` does not have it.
    """
    root = os.environ.get("ENGRAM_DATA")
    odometry = Path(root or "") / "kitti_odometry"
    clip, truth = odometry / "sequences" / "06", odometry / "poses" / "06.txt"
    if not root or not clip.is_dir() or not truth.is_file():
        raise ConfigError(f"ENGRAM_DATA is {root!r}: must name a folder with {clip} and {truth}")
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(truth)]
    pairs = [pair for pair in open_drive(clip) if isinstance(pair, StereoPair)]
    return list(zip(poses, pairs, strict=False))[:CLIP_FRAMES]


def town_like_clip() -> Clip:
    """As many frames of the town by KITTI's camera, at the clip's spacing."""
    village = campaign_named("village")
    plan = replace(village.session(_SESSION), robot="kitti")
    sessions = (*village.sessions[:_SESSION], plan, *village.sessions[_SESSION + 1 :])
    drive = SimulatedDrive(replace(village, sessions=sessions, spacing_m=CLIP_SPACING_M), _SESSION)
    last = _FIRST_FRAME + CLIP_FRAMES
    poses = drive.world_from_cams()[_FIRST_FRAME:last]
    return list(zip(poses, drive.frames(_FIRST_FRAME, last), strict=True))


def falloff(clip: Clip, every: int = 2) -> dict[int, float]:
    """Mean right inliers between a frame and the one so many frames further on."""
    frames = [map_frame(SIFT, pose, pair) for pose, pair in clip]
    found = {}
    for step in _STEPS:
        counts = []
        for first in range(0, len(clip) - step, every):
            pose, pair = clip[first + step]
            answer = placed(SIFT, pair.left, [frames[first]], pair.camera, pose)
            counts.append(answer.inliers if answer.off_m < _RIGHT_M else 0)
        found[step] = float(np.mean(counts))
    return found


@dataclass(frozen=True, slots=True)
class Look:
    """What one pair is like.

    Attributes:
        corners: of FAST at 20 grey levels.
        contrast: deviation of the grey levels ÷ their mean.
        noise: deviation, grey levels (Immerkær 1996, on the half without edges).
        spectrum: power of the logarithm of amplitude over that of frequency; natural scenes: −1.
        matches: of the two sides by SIFT.
    """

    corners: float
    contrast: float
    noise: float
    spectrum: float
    matches: float

    @staticmethod
    def of(pose: SE3, pair: StereoPair) -> Look:
        """Of a pair."""
        image = pair.left
        corners = cv2.FastFeatureDetector.create(20).detect(image, None)
        grey = image.astype(np.float32)
        return Look(
            len(corners), float(grey.std() / grey.mean()), noise_of(grey), spectrum_of(grey),
            len(map_frame(SIFT, pose, pair).words),
        )  # fmt: skip


def noise_of(grey: NDArray[np.float32]) -> float:
    """Deviation of the noise of an image (h, w), where it has no edges."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    found = np.abs(cv2.filter2D(grey, -1, kernel))
    edges = cv2.boxFilter(np.abs(cv2.Laplacian(grey, cv2.CV_32F)), -1, (9, 9))
    smooth = edges <= np.median(edges)
    return float(np.sqrt(np.pi / 2) * found[smooth].mean() / 6)


def spectrum_of(grey: NDArray[np.float32]) -> float:
    """Slope of the amplitude of an image (h, w) over frequencies of 1/64 to 1/4 px, log by log."""
    side = min(grey.shape)
    left = (grey.shape[1] - side) // 2
    square = grey[:side, left : left + side] - grey[:side, left : left + side].mean()
    window = np.hanning(side)
    amplitude = np.abs(np.fft.fft2(square * np.outer(window, window)))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    edges = np.geomspace(1 / 64, 1 / 4, 13)
    rings = np.digitize(frequency, edges)
    means = [float(amplitude[rings == ring].mean()) for ring in range(1, len(edges))]
    middles = np.sqrt(edges[1:] * edges[:-1])
    return float(np.polyfit(np.log(middles), np.log(means), 1)[0])


def figures(road: Clip, town: Clip) -> Iterator[Figure]:
    """Means over every tenth pair, and inliers by the distance ahead: road, then town ÷ road."""
    looks = [[Look.of(pose, pair) for pose, pair in clip[::10]] for clip in (road, town)]
    for field in fields(Look):
        there, here = (float(np.mean([getattr(one, field.name) for one in of])) for of in looks)
        yield Figure(f"{field.name}: on the clip", there)
        yield Figure(f"{field.name}: in the town / on the clip", here / there)
    there_by, here_by = falloff(road), falloff(town)
    for step in _STEPS:
        name = f"{step * CLIP_SPACING_M:.1f} m ahead"
        yield Figure(f"{name}: inliers on the clip", there_by[step])
        yield Figure(f"{name}: inliers in the town / on the clip", here_by[step] / there_by[step])


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="a frame of each, in half size"
    )
    asked = parser.parse_args()
    road, town = load_clip(), town_like_clip()
    report(figures(road, town), asked.json)
    if asked.picture is not None:
        both = np.vstack([road[20][1].left, town[20][1].left])
        half = cv2.resize(both, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        if not cv2.imwrite(str(asked.picture), half):
            raise SystemExit(f"{asked.picture}: cannot be written")


if __name__ == "__main__":
    main()
