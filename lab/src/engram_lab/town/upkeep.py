"""Frame logs of older odometry: odometry is run over their landmarks again, nothing is rendered."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from pathlib import Path

from engram.config import config_hash
from engram.errors import IncompatibleError
from engram.frontend import Frontend, FrontendConfig
from engram.monitor import write_whole
from engram.odometry import Odometry
from engram.robot import Settings
from engram.sequences import FrameLog, FrameLogWriter, LoggedFrame
from engram.sequences.framelog.header import FrameLogHeader


class Upkeep(Enum):
    """Result of checking a log."""

    KEPT = "kept"
    REWRITTEN = "rewritten"
    # Its front-end took no second look, which some of its frames would get now.
    OUTDATED = "outdated"


def bring_up_to_date(path: Path, settings: Settings) -> Upkeep:
    """Rewrites a log of older odometry, or of a front-end that gives the same landmarks.

    Odometry is run over the landmarks again. A log of a front-end without a second look holds what
    one with it gives, if no frame lacks landmarks; only then it becomes one of the other. One of a
    front-end that compared the sides as they are holds what is measured now: both cameras of a
    rendered rig have one exposure. The log is replaced in one step; frames, hashes of images and
    the drive's identity stay.

    Args:
        path: NAME.framelog, recorded to its end.
        settings: of front-end and odometry.

    Raises:
        IncompatibleError: it was made by another front-end: its landmarks are others.
        MapError: it cannot be read or written; it stays as it was.
    """
    log = FrameLog(path)
    try:
        frontend, odometry = Frontend(settings.frontend).hash, config_hash(settings.odometry)
        outdated = False
        if log.header.frontend not in known_frontends(settings):
            raise IncompatibleError(
                f"{path}: was rendered with another version or other settings of the front-end "
                f"({log.header.frontend}, now {frontend}); give another --out, or remove the "
                "folder to render again"
            )
        looks_twice = settings.frontend.second_threshold > 0
        once = looks_twice and log.header.frontend in _looking_once(settings)
        if once and _lacks_landmarks(log, settings):
            outdated, frontend = True, log.header.frontend
        header = replace(log.header, odometry=odometry, frontend=frontend)
        if header != log.header:
            with write_whole(path) as draft:
                _rewrite(log, draft, header, settings)
    finally:
        log.close()
    if outdated:
        return Upkeep.OUTDATED
    return Upkeep.KEPT if header == log.header else Upkeep.REWRITTEN


def known_frontends(settings: Settings) -> set[str]:
    """Hashes of the front-end, and of those before it whose logs can be brought up to date."""
    return _frontends(settings.frontend) | _looking_once(settings)


def _looking_once(settings: Settings) -> set[str]:
    """Of the same front-end without its second look."""
    return _frontends(replace(settings.frontend, second_threshold=0))


def _frontends(config: FrontendConfig) -> set[str]:
    """Of a front-end, and of that which compared the sides as they are."""
    return {Frontend(one).hash for one in (config, replace(config, side_difference=0))}


def _lacks_landmarks(log: FrameLog, settings: Settings) -> bool:
    wanted = settings.frontend.landmarks_for(log.camera.width * log.camera.height)
    return any(len(one.frame.landmarks.pixels) < wanted for one in log)


def _rewrite(log: FrameLog, draft: Path, header: FrameLogHeader, settings: Settings) -> None:
    engine = Odometry(settings.odometry)
    with FrameLogWriter(draft, header) as writer:
        for index, logged in enumerate(log):
            frame = replace(logged.frame, frontend=header.frontend)
            writer.append(LoggedFrame(frame, engine.step(frame)), log.pair_hash(index))
