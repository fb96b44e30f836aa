"""Recording a drive's frames and odometry as a frame log."""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from engram.config import config_hash
from engram.counts import counted
from engram.doctor.findings import Diagnosis
from engram.errors import SequenceError
from engram.frontend import Frame, FrameStatus
from engram.monitor import QUIET, Monitor, deferred_interrupt
from engram.odometry import OdometryStatus
from engram.robot.front import Front, arriving
from engram.robot.session import DriveSequence
from engram.robot.settings import Settings
from engram.sequences import (
    FrameLog,
    FrameLogHeader,
    FrameLogWriter,
    LoggedFrame,
    first_pair_hash,
)


@dataclass(slots=True)
class ExtractReport:
    """Result of recording a drive.

    Attributes:
        log: the file.
        frames: frames recorded by this run.
        already_recorded: frames that an earlier run had recorded.
        unusable: unusable frames: dark, covered, too few landmarks.
        without_motion: frames whose odometry failed.
        skipped: pairs left out under `skip_bad`.
        bytes: size of the file.
        interrupted: whether the run was stopped; the same command continues it.
        diagnosis: what the doctor found in the first frames; a log holds no images for it to see.
    """

    log: str
    frames: int = 0
    already_recorded: int = 0
    unusable: int = 0
    without_motion: int = 0
    skipped: int = 0
    bytes: int = 0
    interrupted: bool = False
    diagnosis: Diagnosis | None = None

    def to_dict(self) -> dict[str, Any]:
        """What ``record --json`` prints."""
        findings = [] if self.diagnosis is None else self.diagnosis.to_dict()["findings"]
        values = asdict(replace(self, diagnosis=None))
        del values["diagnosis"]
        return {**values, "findings": findings}

    def text(self) -> str:
        """For people."""
        total = self.frames + self.already_recorded
        line = (
            f"{counted(total, 'frame')} in {self.log}, {self.bytes / max(total, 1) / 1e3:.1f} kB "
            f"each; {self.unusable} unusable, {self.without_motion} without motion, "
            f"{counted(self.skipped, 'pair')} skipped"
        )
        if self.interrupted:
            line += "\ninterrupted: progress is saved; give the same command to continue"
        return line


def extract_log(
    sequence: DriveSequence,
    out: Path,
    settings: Settings,
    monitor: Monitor = QUIET,
) -> ExtractReport:
    """Runs a drive's images through front-end and odometry and records the result.

    An interrupted log is continued: odometry depends on earlier frames, so all frames run again,
    and recorded ones are not written twice. The result equals that of an uninterrupted run.

    Args:
        sequence: a drive of images.
        out: NAME.framelog.
        settings: settings of front-end and odometry.
        monitor: receives the status of each frame, and may stop the recording.

    Raises:
        SequenceError: the drive is already a frame log, or its images cannot be used.
        IncompatibleError: the file is the log of another drive or of other frames.
        MapError: the log cannot be written; what was recorded is intact.
    """
    report = ExtractReport(str(out))
    front = Front(settings)
    writer: FrameLogWriter | None = None
    try:
        with closing(arriving(sequence)) as pairs, deferred_interrupt() as raise_if_asked:
            for pair in pairs:
                raise_if_asked()
                if isinstance(pair, LoggedFrame):
                    raise SequenceError(f"{sequence.info.name}: the drive is already a frame log")
                frame, motion = front.take(pair)
                step = motion.odometry
                if writer is None:
                    writer = FrameLogWriter(out, _header(sequence, frame, settings))
                _count(report, frame.status, step.status)
                pair_hash = first_pair_hash(pair)
                if writer.holds(frame.stamp_ns, pair_hash):
                    report.already_recorded += 1
                    monitor.advance("recorded already")
                else:
                    writer.append(LoggedFrame(frame, step), pair_hash)
                    report.frames += 1
                    monitor.advance(step.status.value)
                monitor.check()
        if writer is None:
            raise SequenceError(f"{sequence.info.name}: no frame can be read")
        writer.close(complete=True)
    except KeyboardInterrupt:
        report.interrupted = True
    finally:
        if writer is not None:
            writer.close()  # also after an error or an interruption: progress is kept
    report.diagnosis = front.diagnosis
    report.skipped = sequence.skipped
    report.bytes = out.stat().st_size if out.exists() else 0
    return report


def _header(sequence: DriveSequence, frame: Frame, settings: Settings) -> FrameLogHeader:
    return FrameLogHeader(
        sequence.info,
        sequence.camera,
        frame.descriptor,
        frame.frontend,
        config_hash(settings.odometry),
        "" if isinstance(sequence, FrameLog) else str(getattr(sequence, "frames", "")),
    )


def _count(report: ExtractReport, frame: FrameStatus, odometry: OdometryStatus) -> None:
    report.unusable += frame is not FrameStatus.OK
    report.without_motion += odometry not in {OdometryStatus.OK, OdometryStatus.FIRST}
