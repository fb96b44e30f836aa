"""Attempts that are timed: one that succeeds, and one at another place, of which nothing comes."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from engram.frontend.frame import Frame, StereoPair
from engram.frontend.frontend import Frontend
from engram.frontend.matching import MatcherConfig, match_frames
from engram.sequences.opening import open_drive
from engram_lab.bench.data import BenchData, scale_and_crop

_OTHER_DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"

Run = Callable[[int], dict[str, int]]


def attempts_at(references: list[Frame], lives: list[Frame]) -> Run:
    """Matches the i-th pair of frames, without a prediction."""
    matcher = MatcherConfig()

    def run(i: int) -> dict[str, int]:
        at = i % min(len(references), len(lives))
        match = match_frames(references[at], lives[at], matcher, seed=i)
        return {"landmarks": len(references[at].landmarks), "inliers": match.inliers}

    return run


def hopeless(data: BenchData, *, size: str) -> Run:
    """Attempts at frames of another street; without ENGRAM_DATA, of the same one seen mirrored."""
    frontend = Frontend()
    frames = [frontend.extract(pair) for pair in data.at(size)]
    return attempts_at(frames, [frontend.extract(pair) for pair in _elsewhere(data, size)])


def _elsewhere(data: BenchData, size: str) -> list[StereoPair]:
    folder = Path(os.environ.get("ENGRAM_DATA", "")) / _OTHER_DRIVE
    if not folder.is_dir():
        return [_mirrored(pair) for pair in data.at(size)]
    pairs = [pair for pair in open_drive(folder) if isinstance(pair, StereoPair)]
    return [scale_and_crop(pair) for pair in pairs] if size == "512" else pairs


def _mirrored(pair: StereoPair) -> StereoPair:
    """What a mirror would show: right and left change places."""
    left, right = (image[:, ::-1].copy() for image in (pair.right, pair.left))
    return StereoPair(pair.stamp_ns, left, right, pair.camera)


# What `blocks` times in a checkout that does not have these stages.
STAGES: Mapping[str, Callable[[BenchData], Run]] = {
    "attempt_hopeless_512": partial(hopeless, size="512"),
    "attempt_hopeless_full": partial(hopeless, size="full"),
}
