"""The stages of `engram lab bench`: the hot paths of a robot, each against the plain pipeline."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from engram.frontend.frame import Frame, StereoPair
from engram.frontend.frontend import Frontend
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Position
from engram.maps.map import Map, open_map
from engram.odometry.odometry import Odometry, OdometryConfig, WindowConfig
from engram.robot.settings import Settings
from engram.sequences.opening import open_drive
from engram_lab.bench.data import BenchData, scale_and_crop, to_and_fro
from engram_lab.bench.images import NIGHT, RAIN, prepare_rendering, prepare_window
from engram_lab.bench.maps import (
    prepare_opening,
    prepare_places_query,
    prepare_ranking,
    prepare_vocabulary_train,
)
from engram_lab.bench.stage import PlainPipeline, Prepared, Run, Stage

_OTHER_DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"


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


_PERIOD_NS = 100_000_000
_MAPPED = 3  # every so many frames are the map


def prepare_step(data: BenchData, plain: PlainPipeline | None, *, size: str) -> Prepared:
    """`Robot.step` in a map of every third pair, two attempts a frame.

    All included: front-end, odometry with its window, neighbourhood, ranking, both attempts, their
    acceptance and confidence, and what the localiser remembers; not the doctor, who looks at the
    first frames of a drive only. At the end of the drive the robot is put back to its begin.
    """
    del plain
    pairs = data.at(size)
    folder = tempfile.TemporaryDirectory(prefix="engram-bench-")  # lives as long as `ours`
    path = Path(folder.name) / "street.engram"
    with (
        open_map(path, create=True) as opened,
        opened.robot(pairs[0].camera, name="bench", maps=True) as mapper,
    ):
        for number in range(0, len(pairs), _MAPPED):
            mapper.step(_at(number, pairs[number]))
    opened = Map.open(path)
    settings = Settings()
    settings = dataclasses.replace(settings, doctor=dataclasses.replace(settings.doctor, frames=0))
    robot = opened.robot(pairs[0].camera, settings, lanes=2, rounds=1)
    begin = Position(opened.graph.node(0).id, SE3.identity(), 1e-4 * np.eye(6))

    def ours(i: int) -> dict[str, int]:
        at = i % len(pairs)
        if at == 0:
            robot.place_at(begin)
        found = robot.step(_at(i, pairs[at]))
        assert folder.name
        return {
            "attempts": found.attempts,
            "candidates": found.candidates,
            "inliers": found.inliers,
        }

    return Prepared(ours)


def _at(number: int, pair: StereoPair) -> StereoPair:
    return dataclasses.replace(pair, stamp_ns=(number + 1) * _PERIOD_NS)


# Frames between the two of a localisation attempt: 3 to 4 m on the KITTI clip.
_ATTEMPT_GAP = 3
_FRAME_INTERVAL_NS = 100_000_000


def prepare_frontend_odometry(
    data: BenchData, plain: PlainPipeline | None, *, size: str, windowed: bool = False
) -> Prepared:
    """One stereo pair in, one motion out.

    The window is a stage of its own; `windowed` adds it to our side as the product runs it, while
    the reference has none. The drive is played to and fro without end, so every step is a real
    motion.
    """
    pairs = data.at(size)
    frontend = Frontend()
    window = WindowConfig() if windowed else WindowConfig(iterations=0)
    odometry = Odometry(OdometryConfig(window=window))

    def ours(i: int) -> dict[str, int]:
        pair = pairs[to_and_fro(i, len(pairs))]
        frame = frontend.extract(dataclasses.replace(pair, stamp_ns=i * _FRAME_INTERVAL_NS))
        step = odometry.step(frame)
        return {"landmarks": len(frame.landmarks), "inliers": step.inliers}

    if plain is None:
        return Prepared(ours)
    plain_odometry = plain.Odometry(_plain_camera(plain, pairs[0].camera))
    extract = _plain_extract(plain, frontend, pairs)

    def reference(i: int) -> dict[str, int]:
        features = extract(pairs[to_and_fro(i, len(pairs))])
        pose = plain_odometry.step(features)
        counts = {"features": features.detected, "landmarks": len(features.points)}
        return counts | {"inliers": 0 if pose is None else len(pose.inliers)}

    return Prepared(ours, reference)


def prepare_attempt(data: BenchData, plain: PlainPipeline | None, *, size: str) -> Prepared:
    """One localisation attempt without a prediction, 3 frames apart, features made beforehand."""
    pairs = data.at(size)
    frontend = Frontend()
    frames = [frontend.extract(pair) for pair in pairs]
    starts = len(frames) - _ATTEMPT_GAP
    ours = attempts_at(frames[:starts], frames[_ATTEMPT_GAP:])
    if plain is None:
        return Prepared(ours)
    camera = _plain_camera(plain, pairs[0].camera)
    extract = _plain_extract(plain, frontend, pairs)
    features = [extract(pair) for pair in pairs]

    def reference(i: int) -> dict[str, int]:
        at = i % starts
        pose = plain.attempt(features[at], features[at + _ATTEMPT_GAP], camera)
        return {
            "landmarks": len(features[at].points),
            "inliers": 0 if pose is None else len(pose.inliers),
        }

    return Prepared(ours, reference)


def prepare_hopeless(data: BenchData, plain: PlainPipeline | None, *, size: str) -> Prepared:
    """The same at frames of another place."""
    del plain
    return Prepared(hopeless(data, size=size))


STAGES: Mapping[str, Stage] = MappingProxyType(
    {
        "frontend_odometry_512": partial(prepare_frontend_odometry, size="512"),
        "frontend_odometry_full": partial(prepare_frontend_odometry, size="full"),
        "frontend_odometry_windowed_512": partial(
            prepare_frontend_odometry, size="512", windowed=True
        ),
        "frontend_odometry_windowed_full": partial(
            prepare_frontend_odometry, size="full", windowed=True
        ),
        "attempt_512": partial(prepare_attempt, size="512"),
        "attempt_full": partial(prepare_attempt, size="full"),
        "attempt_hopeless_512": partial(prepare_hopeless, size="512"),
        "attempt_hopeless_full": partial(prepare_hopeless, size="full"),
        "robot_step_512": partial(prepare_step, size="512"),
        "robot_step_full": partial(prepare_step, size="full"),
        "open_map_4000": prepare_opening,
        "render_pair_512": prepare_rendering,
        "render_pair_512_rain": partial(prepare_rendering, session=RAIN),
        "render_pair_512_night": partial(prepare_rendering, session=NIGHT),
        "window_ba_512": prepare_window,
        "places_query_20000": partial(prepare_places_query, places=20_000, dense=True),
        "places_query_1000000": partial(prepare_places_query, places=1_000_000, dense=False),
        "vocabulary_train": prepare_vocabulary_train,
        "rank_path_150": partial(prepare_ranking, policy="path-near", paths=150),
        "rank_path_10000": partial(prepare_ranking, policy="path-near", paths=10_000),
        "rank_recall_150": partial(prepare_ranking, policy="recall", paths=150),
        "rank_recall_10000": partial(prepare_ranking, policy="recall", paths=10_000),
    }
)


def _plain_camera(plain: PlainPipeline, camera: StereoCamera) -> Any:
    names = ("fx", "fy", "cx", "cy", "baseline_m", "width", "height")
    return plain.Camera(*(getattr(camera, name) for name in names))


def _plain_extract(
    plain: PlainPipeline, frontend: Frontend, pairs: tuple[StereoPair, ...]
) -> Callable[[StereoPair], Any]:
    """The plain front-end, describing as many corners as ours has landmarks (median, ± 10 %)."""
    camera = _plain_camera(plain, pairs[0].camera)
    few = pairs[:: max(1, len(pairs) // 5)]
    wanted = round(float(np.median([len(frontend.extract(pair).landmarks) for pair in few])))
    asked = wanted
    for _ in range(5):  # its grid holds some back: ask for more until it gives as many
        plain_frontend = plain.FrontEnd(camera, asked)
        got = float(
            np.median([plain_frontend.extract(pair.left, pair.right).detected for pair in few])
        )
        if got > 0.95 * wanted:
            break
        asked = round(asked * wanted / max(got, 1.0))
    return lambda pair: plain_frontend.extract(pair.left, pair.right)
