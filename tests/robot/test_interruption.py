"""Ctrl-C, and runs that are stopped and gone on with."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest

from engram.errors import ConfigError
from engram.frontend.frame import StereoPair
from engram.graph.model import path_id
from engram.mapper.mapper import MapperConfig
from engram.maps.map import Map, open_map
from engram.monitor import Advancing, deferred_interrupt
from engram.robot.inspecting import check_map
from engram.robot.localisers import DriveSequence
from engram.robot.mapping import MapReport, map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.bench.data import synthetic_drive
from engram_lab.there_and_back import ThereAndBack

CHECKPOINT_EVERY = 4
SETTINGS = Settings(mapper=MapperConfig(checkpoint_every=CHECKPOINT_EVERY))


def run(town: Path, drive: DriveSequence, stop_after: int | None = None) -> MapReport:
    return map_drive(town, drive, SETTINGS, RobotOptions(), Advancing(interrupt_after(stop_after)))


def interrupt_after(frames: int | None) -> Callable[[str], None]:
    seen = 0

    def advance(_: str) -> None:
        nonlocal seen
        seen += 1
        if seen == frames:
            raise KeyboardInterrupt

    return advance


def path_of(town: Path) -> list[tuple[int, str, int]]:
    with Map.open(town) as store:
        contents = store.load()
        last = path_id(contents.sessions[-1].id)
        entries = [one for one in contents.path_entries if one.path == last]
        return [(one.sequence, str(one.node), one.stamp_ns) for one in entries]


_EARLY, _LATE = (pytest.param(count, marks=pytest.mark.long) for count in (1, 10))


@pytest.mark.parametrize("stop_after", [_EARLY, 5, _LATE])
def test_a_drive_that_saves_nothing_is_resumed_where_it_stopped(
    street: Path, tmp_path: Path, stop_after: int
) -> None:
    whole, parts = tmp_path / "whole.engram", tmp_path / "parts.engram"
    for town in (whole, parts):
        run(town, open_drive(street, frames="0::2"))
    again = lambda: ThereAndBack(open_drive(street, frames="1::2"), 16)  # noqa: E731
    run(whole, again())
    first = run(parts, again(), stop_after)
    assert first.interrupted
    assert first.saved == 0
    second = run(parts, again())
    assert second.resumed
    assert not second.interrupted
    assert second.revision == 2
    assert len(first.results) + len(second.results) >= 16
    assert len(repr(second)) < 2_000  # as an interactive session prints it
    assert check_map(parts)["sound"]
    sequences = [sequence for sequence, _, _ in path_of(parts)]
    assert sequences == list(range(len(sequences)))
    stamps = [stamp_ns for _, _, stamp_ns in path_of(parts)]
    assert stamps == sorted(set(stamps))  # no frame went into the path twice


@pytest.mark.parametrize("stop_after", [_EARLY, 6, _LATE])
def test_a_resumed_first_drive_gives_the_same_map(
    street: Path, tmp_path: Path, stop_after: int
) -> None:
    hashes = []
    for name, stop in (("whole", None), ("parts", stop_after)):
        town = tmp_path / f"{name}.engram"
        if stop is not None:
            assert run(town, open_drive(street), stop).interrupted
        run(town, open_drive(street))
        with Map.open(town) as store:
            hashes.append(store.content_hash())
    assert hashes[0] == hashes[1]


def test_a_first_ctrl_c_waits_and_a_second_does_not() -> None:
    reached = False
    with deferred_interrupt() as raise_if_asked:
        raise_if_asked()
        os.kill(os.getpid(), signal.SIGINT)
        reached = True
        with pytest.raises(KeyboardInterrupt):
            raise_if_asked()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert reached
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_the_program_is_left_alone() -> None:
    calls: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: calls.append(number))
    try:
        with deferred_interrupt() as raise_if_asked:
            os.kill(os.getpid(), signal.SIGINT)
            raise_if_asked()
    finally:
        signal.signal(signal.SIGINT, before)
    assert calls == [signal.SIGINT]


class Endless:
    """Pairs for ever."""

    def __init__(self, pair: StereoPair) -> None:
        self._pair = pair

    def __iter__(self):
        for number in count():
            yield replace(self._pair, stamp_ns=number)


def test_ctrl_c_ends_a_drive_between_two_frames_and_its_thread_with_it(tmp_path: Path) -> None:
    (pair,), seen = synthetic_drive(frames=1), []

    def watch() -> None:
        town = open_map(tmp_path / "empty.engram", create=True)
        with town, town.robot(pair.camera) as robot:
            for found in robot.drive(Endless(pair)):
                seen.append(found.stamp_ns)
                if len(seen) == 3:
                    os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        watch()
    assert len(seen) == 3
    assert not [one for one in threading.enumerate() if one.name == "engram-reader"]


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan")])
def test_a_rate_that_is_none_is_refused(rate_hz: float, tmp_path: Path) -> None:
    pairs = synthetic_drive(frames=1)
    with open_map(tmp_path / "empty.engram", create=True) as town:
        robot = town.robot(pairs[0].camera)
        with robot, pytest.raises(ConfigError, match="rate"):
            next(robot.drive(pairs, rate_hz=rate_hz))
