"""The stage of a whole step: a robot that is localised in a map of the same street."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Position
from engram.maps.map import Map, open_map
from engram.robot.settings import Settings
from engram_lab.bench.data import BenchData
from engram_lab.bench.plain import PlainPipeline
from engram_lab.bench.stage import Prepared, Run

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
    if hasattr(settings, "doctor"):  # a checkout from before there was one can be the other side
        settings = dataclasses.replace(
            settings, doctor=dataclasses.replace(settings.doctor, frames=0)
        )
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


# What `blocks` times in a checkout that does not have these stages.
STAGES: Mapping[str, Callable[[BenchData], Run]] = {
    "robot_step_512": lambda data: prepare_step(data, None, size="512").ours,
    "robot_step_full": lambda data: prepare_step(data, None, size="full").ours,
}


def _at(number: int, pair: StereoPair) -> StereoPair:
    return dataclasses.replace(pair, stamp_ns=(number + 1) * _PERIOD_NS)
