"""Frame logs of older odometry: odometry is run over their landmarks again, nothing is rendered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from engram.config import config_hash
from engram.errors import IncompatibleError
from engram.frontend import Frontend
from engram.monitor import write_whole
from engram.odometry import Odometry
from engram.robot import Settings
from engram.sequences import FrameLog, FrameLogWriter, LoggedFrame


def bring_up_to_date(path: Path, settings: Settings) -> bool:
    """Runs odometry over a whole log's frames again where it was made by other odometry.

    The log is replaced in one step; frames, hashes of images and the drive's identity stay.

    Args:
        path: NAME.framelog, recorded to its end.
        settings: of front-end and odometry.

    Returns:
        Whether the log was rewritten.

    Raises:
        IncompatibleError: it was made by another front-end: its landmarks are others.
        MapError: it cannot be read or written; it stays as it was.
    """
    log = FrameLog(path)
    try:
        frontend, odometry = Frontend(settings.frontend).hash, config_hash(settings.odometry)
        if log.header.frontend != frontend:
            raise IncompatibleError(
                f"{path}: was rendered with another version or other settings of the front-end "
                f"({log.header.frontend}, now {frontend}); give another --out, or remove the "
                "folder to render anew"
            )
        if log.header.odometry == odometry:
            return False
        with write_whole(path) as draft:
            _rewrite(log, draft, odometry, settings)
    finally:
        log.close()
    return True


def _rewrite(log: FrameLog, draft: Path, odometry: str, settings: Settings) -> None:
    engine = Odometry(settings.odometry)
    with FrameLogWriter(draft, replace(log.header, odometry=odometry)) as writer:
        for index, logged in enumerate(log):
            step = engine.step(logged.frame)
            writer.append(LoggedFrame(logged.frame, step), log.pair_hash(index))
