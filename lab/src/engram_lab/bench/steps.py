"""The stage of a whole step: a robot that is localised in a map of the same street."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

from engram.frontend import StereoPair
from engram.maps import Map, open_map
from engram.robot import Robot
from engram_lab.bench.data import BenchData
from engram_lab.bench.plain import PlainPipeline
from engram_lab.bench.stage import Prepared

_PERIOD_NS = 100_000_000
_MAPPED = 3  # every so many frames are the map


def prepare_step(data: BenchData, plain: PlainPipeline | None, *, size: str) -> Prepared:
    """`Robot.step` in a map of every third pair, two attempts a frame.

    All included: front-end, odometry with its window, neighbourhood, ranking, both attempts, their
    acceptance and confidence, and what the localiser remembers. At the end of the drive a new
    robot begins it again, lost: one step in fifty, which the median does not show.
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
    robot: Robot | None = None

    def ours(i: int) -> dict[str, int]:
        nonlocal robot
        at = i % len(pairs)
        if robot is None or at == 0:
            if robot is not None:
                robot.close()
            robot = opened.robot(pairs[0].camera, lanes=2, rounds=1)
        found = robot.step(_at(at, pairs[at]))
        assert folder.name
        return {
            "attempts": found.attempts,
            "candidates": found.candidates,
            "inliers": found.inliers,
        }

    return Prepared(ours)


def _at(number: int, pair: StereoPair) -> StereoPair:
    return dataclasses.replace(pair, stamp_ns=(number + 1) * _PERIOD_NS)
