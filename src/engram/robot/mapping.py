"""Mapping a whole drive, the doctor's part in it, and recording it as a frame log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from engram.config import config_hash
from engram.counts import counted
from engram.doctor.examination import Facts
from engram.doctor.table import Diagnosis
from engram.errors import ConfigError, SequenceError, UnfitDriveError
from engram.files import check_parent
from engram.frontend.features import feature_kind
from engram.frontend.frame import DescriptorKind, Frame, FrameStatus
from engram.frontend.ranked import ranked_landmarks
from engram.geometry.cameras import StereoCamera
from engram.graph.model import Session
from engram.keywords import keywords
from engram.localiser.localisation import Localisation
from engram.maps.map import Map, open_map
from engram.maps.records import SessionState
from engram.monitor import QUIET, Monitor, deferred_interrupt, interruptible
from engram.odometry.outside import MotionSource, OutsideMotion
from engram.odometry.step import OdometryStatus
from engram.robot.anchors import fixes_of
from engram.robot.drive_session import DriveSession, RobotSetup, node_words
from engram.robot.front import Arrived, Front, arriving, stamp_of
from engram.robot.localisers import DriveSequence, session_of_drive
from engram.robot.robot import Robot
from engram.robot.settings import RobotOptions, Settings
from engram.robot.spool import commit_spools
from engram.robot.starting import summarise
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.layouts import ImageSequence
from engram.sequences.motion_files import MovedSequence
from engram.sequences.opening import Drive, stamps_of
from engram.sequences.sequence import LoggedFrame, SequenceInfo, first_pair_hash

# A long drive is examined in so many stretches, as it may begin at rest or in the dark.
_STRETCHES = 4


def facts_of(sequence: DriveSequence, *, by_hour: bool = False) -> Facts:
    """Facts about a drive in addition to its frames."""
    info = sequence.info
    step = sequence.frames.step if isinstance(sequence, ImageSequence) else 1
    bits = sequence.bits() if isinstance(sequence, ImageSequence) else None
    return Facts(info.clock, info.zone, info.longitude_deg, by_hour, step, bits)


def examine_drive(
    sequence: Drive,
    settings: Settings | None = None,
    monitor: Monitor = QUIET,
    *,
    by_hour: bool = False,
    seen: Callable[[int, Arrived], None] = lambda *_: None,
) -> Diagnosis:
    """Examines up to `DoctorConfig.frames` frames of a drive, in stretches spread over it.

    Of a bag, which is a stream, the first ones.

    Open the drive with `skip_bad`: then bad pairs and stamps out of order are findings, not errors.

    Args:
        settings: the resolved configuration; None for the defaults.
        monitor: receives each frame, and may stop the examination.
        by_hour: whether missions by hour need the drive's clock.
        seen: called with the number and the images of each frame that is examined.
    """
    front = Front(settings or Settings())
    evidence = front.examination.evidence
    evidence.facts = facts_of(sequence, by_hour=by_hour)
    with interruptible(monitor) as watched:
        chosen = _chosen(sequence, front, evidence.config.frames)
        for number, (arrived, outside) in enumerate(chosen):
            front.take(arrived, outside)
            seen(number, arrived)
            watched.advance("examined")
            watched.check()
    evidence.bad += sequence.skipped_reasons
    evidence.read = stamps_of(sequence)
    return front.diagnosis


def _chosen(
    sequence: Drive, front: Front, most: int
) -> Iterator[tuple[Arrived, OutsideMotion | None]]:
    """The frames that are examined; the front starts again with each stretch of them."""
    source = sequence.motion()
    runs: Iterable[Iterable[Arrived]] = [islice(sequence, most)]
    if isinstance(sequence, ImageSequence):
        runs = (sequence.usable(stretch) for stretch in stretches(len(sequence), most))
    elif isinstance(sequence, FrameLog):
        runs = (map(sequence.read, stretch) for stretch in stretches(len(sequence), most))
    for run in runs:
        front.restart()
        last_ns: int | None = None
        for arrived in run:
            stamp_ns = stamp_of(arrived)
            if source is None or last_ns is None:
                yield arrived, None
            else:
                yield arrived, source.between(last_ns, stamp_ns)
            last_ns = stamp_ns


def stretches(length: int, most: int) -> list[range]:
    """Up to `most` frames of a drive: all of them, or runs of successive ones spread over it."""
    if length <= most:
        return [range(length)]
    each = max(most // _STRETCHES, 1)
    starts = np.linspace(0, length - each, min(_STRETCHES, most)).round().astype(int)
    return [range(int(start), int(start) + each) for start in starts]


class LookedAhead:
    """A drive whose first frames were taken ahead, so that the doctor saw them before the map.

    Images of those frames are not kept: they come as logged frames, the others as they are. It can
    be iterated over once.

    Args:
        front: takes the frames, and later those of the robot that drives on.
    """

    def __init__(self, front: Front, sequence: DriveSequence, monitor: Monitor = QUIET) -> None:
        self.sequence = sequence
        self._begin()
        self._look(front, monitor)
        if front.fixed_share:  # what is fixed to the camera is left out from the first frame on
            front.look_again()
            self._rest.close()
            self._begin()
            self._look(front, monitor)

    def _begin(self) -> None:
        sequence = self.sequence
        self._rest = arriving(sequence)
        self._ahead: list[LoggedFrame] = []
        self._outside = sequence.motion() if isinstance(sequence, MovedSequence) else None
        # Stamp of the last frame that was taken ahead.
        self._until_ns: int | None = None

    def _look(self, front: Front, monitor: Monitor) -> None:
        """Takes frames ahead until the doctor has seen enough."""
        with deferred_interrupt() as raise_if_asked:
            while not front.examination.full:
                arrived = next(self._rest, None)
                if arrived is None:
                    break
                self._take(front, arrived)
                monitor.check()
                raise_if_asked()

    def _take(self, front: Front, arrived: Arrived) -> None:
        """Takes one frame ahead, with the motion from outside that led to it."""
        stamp_ns, outside = stamp_of(arrived), None
        if self._outside is not None and self._until_ns is not None:
            outside = self._outside.between(self._until_ns, stamp_ns)
        self._ahead.append(front.take_ahead(arrived, outside))
        self._until_ns = stamp_ns

    def motion(self) -> MotionSource | None:
        """The motion from outside that was not used ahead."""
        return None if self._outside is None else self

    def between(self, start_ns: int, end_ns: int) -> OutsideMotion | None:
        """See `MotionSource`; None where the frames were taken ahead."""
        if self._outside is None or (self._until_ns is not None and end_ns <= self._until_ns):
            return None
        return self._outside.between(start_ns, end_ns)

    @property
    def info(self) -> SequenceInfo:
        """Facts about the drive as a whole."""
        return self.sequence.info

    @property
    def camera(self) -> StereoCamera:
        """The one camera of the drive."""
        return self.sequence.camera

    def __len__(self) -> int:
        return len(self.sequence)

    def __iter__(self) -> Iterator[Arrived]:
        ahead, self._ahead = self._ahead, []
        return chain(ahead, self._rest)

    def close(self) -> None:
        """Ends the thread that reads ahead."""
        self._rest.close()


def refuse_unfit(diagnosis: Diagnosis, name: str, options: RobotOptions) -> None:
    """Refuses a drive with a fatal finding, unless it is forced.

    Raises:
        UnfitDriveError: what is wrong with it.
    """
    if diagnosis.fatal and not options.force:
        findings = "\n".join(finding.text() for finding in diagnosis.fatal)
        raise UnfitDriveError(
            f"{name}: not mapped, nothing was written; --force maps it anyway\n{findings}"
        )


@dataclass(slots=True)
class MapReport:
    """Result of mapping a drive.

    Attributes:
        revision: number of the revision that holds it; None if it was interrupted.
        known: whether the map already held this drive, so that nothing was done.
        resumed: whether the run continued an earlier one.
        interrupted: whether the run was stopped; its progress is saved and can be resumed.
        skipped: pairs left out under `skip_bad`.
        diagnosis: what the doctor found in the first frames; None if nothing was done.
        results: one per live frame.
    """

    session: Session
    revision: int | None = None
    known: bool = False
    resumed: bool = False
    interrupted: bool = False
    skipped: int = 0
    wrong_stamps: int = 0
    diagnosis: Diagnosis | None = None
    results: list[Localisation] = field(default_factory=list, repr=False)

    @property
    def saved(self) -> int:
        """Nodes added."""
        return sum(result.saved is not None for result in self.results)

    def to_dict(self) -> dict[str, Any]:
        """What ``map --json`` prints."""
        return {
            "session": str(self.session.id),
            "robot": self.session.robot,
            "revision": self.revision,
            "known": self.known,
            "resumed": self.resumed,
            "interrupted": self.interrupted,
            "nodes_saved": self.saved,
            "skipped_pairs": self.skipped,
            "wrong_stamps": self.wrong_stamps,
            "findings": [] if self.diagnosis is None else self.diagnosis.to_dict()["findings"],
            **summarise(self.results),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Beginning:
    """A drive that is about to be mapped.

    Attributes:
        opened: the map, open for writing.
        robot: the robot before its first frame.
        resumed: whether the drive continues an earlier run, so that the robot's position is known.
    """

    opened: Map
    robot: Robot
    resumed: bool


@keywords(descriptor="features")
def map_drive(
    map_path: Path | str,
    sequence: DriveSequence,
    settings: Settings | None = None,
    options: RobotOptions | None = None,
    monitor: Monitor = QUIET,
    begin: Callable[[Beginning], None] | None = None,
    features: str | None = None,
) -> MapReport:
    """Adds a drive to a map; creates the map if there is none.

    A drive that the map already holds changes nothing; an interrupted one is resumed. Ctrl-C stops
    the run and keeps its progress.

    Args:
        map_path: NAME.engram.
        sequence: the drive, as `open_drive` gives it.
        settings: the resolved configuration, kept with the revision; None for the defaults.
        options: how to map it; None for the defaults.
        monitor: receives the status of each frame, and may stop the drive.
        begin: called before the first frame, to set the robot's position or to watch it.
        features: required kind of features: "brief", "net", "teblid"; None for that of the frame
            log, the map or the settings, whichever is known first.

    Raises:
        ConfigError: a keyword is unknown, the frame log or the map has another kind of features
            than required, or the threads are too few.
        InputError: the sequence is a path or a list, not a drive.
        MapError: the map cannot be read or written; what was checkpointed is intact.
        SequenceError: the drive's images cannot be used; the earlier frames are saved.
        UnfitDriveError: the doctor found something fatal, and `options.force` is not set; nothing
            was written.
    """
    map_path = Path(map_path)
    settings, options = settings or Settings(), options or RobotOptions()
    if features is not None and isinstance(sequence, FrameLog):
        mend = f"record it again with --features {features}"
        _check_features(features, sequence.header.descriptor, str(sequence.path), mend)
    options.lane_threads(maps=True)  # refuses too few threads before anything is written
    session = session_of_drive(sequence)
    report = MapReport(session)
    commit_spools(map_path)
    check_parent(map_path)
    # A new map is made once the drive's first frames are read: nothing stays if they cannot be.
    with _written(map_path) if map_path.exists() else nullcontext() as opened:
        if opened is not None:
            if features is not None:
                mend = "map the drive into another map"
                _check_features(features, opened.descriptor, str(map_path), mend)
            if opened.session_state(session.id) is SessionState.COMMITTED:
                report.known = True
                return report
            report.resumed = opened.session_state(session.id) is SessionState.INTERRUPTED
        wanted = None if features is None else feature_kind(features).name
        settings = settings.for_descriptor(wanted if opened is None else opened.descriptor)
        into = _written(map_path) if opened is None else nullcontext(opened)
        setup = RobotSetup(
            sequence.camera, settings, options, session.robot, session, fixes_of(sequence)
        )
        front = Front(settings)
        front.examination.evidence.facts = facts_of(sequence)
        try:
            with closing(LookedAhead(front, sequence, monitor)) as drive:
                report.diagnosis = front.diagnosis
                refuse_unfit(front.diagnosis, sequence.info.name, options)
                with into as written:
                    _save(written, setup, drive, front, begin or (lambda _: None), report, monitor)
        except KeyboardInterrupt:
            report.interrupted = True
    report.skipped = sequence.skipped
    report.wrong_stamps = stamps_of(sequence).left_out
    return report


@contextmanager
def _written(map_path: Path) -> Iterator[Map]:
    """A map, made if there is none, locked for writing."""
    with open_map(map_path, create=True) as opened, opened.writing():
        yield opened


def _check_features(asked: str, found: DescriptorKind | None, what: str, mend: str) -> None:
    """Refuses a required kind of features that differs from the existing one."""
    if found is not None and found != feature_kind(asked).name:
        raise ConfigError(
            f"{what} has {found} features, not {asked}; leave out --features and "
            f"frontend.descriptor, or {mend}"
        )


def _save(
    opened: Map,
    setup: RobotSetup,
    drive: LookedAhead,
    front: Front,
    begin: Callable[[Beginning], None],
    report: MapReport,
    monitor: Monitor,
) -> None:
    """Drives through a drive that is fit, or forced; commits it, or leaves it for a later run."""
    session, sequence, settings = report.session, drive.sequence, setup.settings
    forced = ", ".join(finding.code for finding in front.diagnosis.fatal)
    message = f"map {sequence.info.name}" + (f" (forced: {forced})" if forced else "")
    header = setup.header(session, sequence, message, doctor=front.diagnosis.to_dict())
    # First: what follows reads a resumed session's nodes.
    writer = header.begin_or_resume(opened)
    relocaliser = setup.options.relocaliser
    words = node_words(opened, settings, relocaliser)
    localiser = setup.localiser_in(opened, maps=True)
    saved = DriveSession.mapped(opened, writer, localiser, settings, words)
    robot = Robot(front, localiser, saved.result_sink, deadline_ms=setup.options.deadline_ms)
    begin(Beginning(opened, robot, report.resumed))
    try:
        with robot, closing(robot.drive(drive, monitor)) as results:
            report.results.extend(result for result in results if not result.resumed)
        report.diagnosis = front.diagnosis  # with what the map shows of the calibration
        saved.finish()
    finally:
        saved.close()
    revision = saved.commit()
    assert revision is not None
    report.revision = revision.number


@dataclass(slots=True)
class ExtractReport:
    """Result of recording a drive.

    Attributes:
        frames: frames recorded by this run.
        already_recorded: frames that an earlier run had recorded.
        unusable: unusable frames: dark, covered, too few landmarks.
        without_motion: frames whose odometry failed.
        skipped: pairs left out under `skip_bad`.
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
    most_landmarks: int = 0,
) -> ExtractReport:
    """Runs a drive's images through front-end and odometry and records the result.

    An interrupted log is continued: odometry depends on earlier frames, so all frames run again,
    and recorded ones are not written twice. The result equals that of an uninterrupted run.

    Args:
        out: NAME.framelog.
        monitor: receives the status of each frame, and may stop the recording.
        most_landmarks: of each frame that the log keeps, in the front-end's order, beyond those
            that it has; 0 for none.
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
                    ranked = None
                    if most_landmarks:
                        ranked = ranked_landmarks(pair, settings.frontend, most_landmarks)
                    writer.append(LoggedFrame(frame, step), pair_hash, ranked)
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
