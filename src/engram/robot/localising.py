"""Localising a whole drive in a map that stays as it is."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from engram.errors import ConfigError
from engram.localiser import Budget, Localiser
from engram.maps import open_map
from engram.ranking import check_for_robot
from engram.robot.live import LiveFrame, live_frames
from engram.robot.localisers import localiser_in
from engram.robot.results import FrameResult
from engram.robot.session import DriveSequence, session_of_drive
from engram.robot.settings import Settings


@dataclass(frozen=True, slots=True)
class LocaliseOptions:
    """How a drive is localised.

    Attributes:
        policy: key of `POLICIES`.
        lanes, rounds: the budget of each frame.
        deadline_ms: no attempt starts later than this after its frame arrived; None for no limit.
        relocaliser: key of `RELOCALISERS`; None for none.
        at: number or tag of the map's revision; None for the newest.
        rate_hz: replay in real time; None for as fast as it goes.
        preload: decode all images before the first frame.
    """

    policy: str = "recall"
    lanes: int = 2
    rounds: int = 2
    deadline_ms: float | None = None
    relocaliser: str | None = "fabmap"
    at: int | str | None = None
    rate_hz: float | None = None
    preload: bool = False

    def __post_init__(self) -> None:
        check_for_robot(self.policy)
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise ConfigError(f"rate is {self.rate_hz} Hz, must be > 0")


class LocaliseRun:
    """A drive being localised: iterate for each live frame and its result. A context manager.

    Attributes:
        opened: the map.
        localiser: the localiser of this drive.
    """

    def __init__(
        self, map_path: Path, sequence: DriveSequence, settings: Settings, options: LocaliseOptions
    ) -> None:
        self.opened = open_map(map_path, options.at)
        self._sequence = sequence
        self._settings = settings.for_descriptor(self.opened.descriptor)
        self._options = options
        self._frames: Generator[LiveFrame] | None = None
        self.localiser: Localiser = localiser_in(
            self.opened,
            sequence.camera,
            self._settings,
            policy=options.policy,
            budget=Budget(options.lanes, options.rounds, deadline_ms=options.deadline_ms),
            relocaliser=options.relocaliser,
            live=session_of_drive(sequence).id,
            clock=sequence.info,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._frames is not None:
            self._frames.close()
        self.localiser.close()
        self.opened.close()

    def __iter__(self) -> Iterator[tuple[LiveFrame, FrameResult]]:
        options = self._options
        self._frames = live_frames(self._sequence, self._settings, options.rate_hz, options.preload)
        for live in self._frames:
            deadline = (
                None if options.deadline_ms is None else live.arrived + options.deadline_ms / 1e3
            )
            self.localiser.move(live.motion)
            found = self.localiser.localise(live.frame, deadline)
            late = self._is_late(time.perf_counter() - live.arrived)
            stage_ms = {**live.stage_ms, **found.stage_ms}
            yield live, FrameResult(found, live.motion.odometry.prev_from_curr, stage_ms, late)

    def _is_late(self, seconds: float) -> bool:
        """In real time, an answer is late after the deadline or, without one, the next frame."""
        if self._options.rate_hz is None:
            return False
        allowed_ms = self._options.deadline_ms or 1e3 / self._options.rate_hz
        return seconds * 1e3 > allowed_ms
