"""Mapping a whole drive: open or resume its session, feed the mapper, commit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from engram.doctor import Diagnosis
from engram.errors import ConfigError
from engram.files import check_parent
from engram.frontend import DescriptorKind, Frontend, feature_kind
from engram.graph.model import Session
from engram.keywords import keywords
from engram.localiser import Localisation, Localiser
from engram.maps import Map, RevisionWriter, SessionState, open_map
from engram.monitor import QUIET, Monitor
from engram.robot.examining import LookedAhead, facts_of, refuse_unfit
from engram.robot.fixed import relocaliser_with_fixes
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.results import summarise
from engram.robot.robot import Robot
from engram.robot.saving import SavedDrive, configuration_of, node_words
from engram.robot.session import DriveSequence, session_of_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.spool import commit_spools
from engram.sequences import FrameLog, stamps_of


@dataclass(slots=True)
class MapReport:
    """Result of mapping a drive.

    Attributes:
        session: the drive.
        revision: number of the revision that holds it; None if it was interrupted.
        known: whether the map already held this drive, so that nothing was done.
        resumed: whether the run continued an earlier one.
        interrupted: whether the run was stopped; its progress is saved and can be resumed.
        skipped: pairs left out under `skip_bad`.
        wrong_stamps: pairs left out for their stamp.
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
        return sum(one.saved is not None for one in self.results)

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
        settings = settings.for_descriptor(None if opened is None else opened.descriptor)
        into = _written(map_path) if opened is None else nullcontext(opened)
        _Mapping(into, sequence, settings, options, begin, report).run(monitor)
    report.skipped = sequence.skipped
    report.wrong_stamps = stamps_of(sequence).left_out
    return report


@contextmanager
def _written(map_path: Path) -> Iterator[Map]:
    """A map, made if there is none, locked for writing."""
    with open_map(map_path, create=True) as opened, opened.writing():
        yield opened


def _check_features(asked: str, found: DescriptorKind | None, what: str, mend: str) -> None:
    """Refuses a required kind of features that differs from the existing one.

    Raises:
        ConfigError: they differ.
    """
    if found is not None and found != feature_kind(asked).name:
        raise ConfigError(
            f"{what} has {found} features, not {asked}; leave out --features and "
            f"frontend.descriptor, or {mend}"
        )


@dataclass(frozen=True)
class _Mapping:
    """One run of `map_drive`; `into` opens the map."""

    into: AbstractContextManager[Map]
    sequence: DriveSequence
    settings: Settings
    options: RobotOptions
    begin: Callable[[Beginning], None] | None
    report: MapReport

    def run(self, monitor: Monitor) -> None:
        """Drives through the sequence; commits at the end, or leaves it for a later run."""
        front = Front(self.settings)
        front.examination.evidence.facts = facts_of(self.sequence)
        try:
            with closing(LookedAhead(front, self.sequence, monitor)) as drive:
                self.report.diagnosis = front.diagnosis
                refuse_unfit(front.diagnosis, self.sequence.info.name, self.options)
                with self.into as opened:
                    self._save(opened, drive, front, monitor)
        except KeyboardInterrupt:
            self.report.interrupted = True

    def _save(self, opened: Map, drive: LookedAhead, front: Front, monitor: Monitor) -> None:
        """The same for a drive that is fit, or forced."""
        writer = self._writer(opened)  # first: what follows reads a resumed session's nodes
        words = node_words(opened, self.settings, self.options.relocaliser)
        localiser = self._localiser(opened)
        saved = SavedDrive(opened, writer, localiser, self.settings, words)
        robot = Robot(front, localiser, saved.mapper, deadline_ms=self.options.deadline_ms)
        if self.begin is not None:
            self.begin(Beginning(opened, robot, self.report.resumed))
        try:
            with robot, closing(robot.drive(drive, monitor)) as found:
                self.report.results.extend(one for one in found if not one.resumed)
            self.report.diagnosis = front.diagnosis  # with what the map told of the calibration
            saved.finish()
        finally:
            saved.close()
        self.report.revision = saved.commit().number

    def _writer(self, opened: Map) -> RevisionWriter:
        """The writer of the drive's revision: a new one, or that of an interrupted run."""
        session, name = self.report.session, self.sequence.info.name
        if opened.session_state(session.id) is SessionState.INTERRUPTED:
            return opened.resume_session(session.id)
        diagnosis = self.report.diagnosis
        assert diagnosis is not None
        forced = ", ".join(one.code for one in diagnosis.fatal)
        configuration = configuration_of(self.settings, self.options)
        descriptor, frontend = _made_by(self.sequence, self.settings)
        return opened.begin_session(
            session,
            self.sequence.camera,
            descriptor=descriptor,
            frontend=frontend,
            author=self.options.author or session.robot,
            message=f"map {name}" + (f" (forced: {forced})" if forced else ""),
            configuration={**configuration, "doctor": diagnosis.to_dict()},
        )

    def _localiser(self, opened: Map) -> Localiser:
        return localiser_in(
            opened,
            self.sequence.camera,
            self.settings,
            policy=self.options.ranking,
            budget=self.options.budget,
            relocaliser=relocaliser_with_fixes(
                opened, self.sequence, self.settings, self.options.relocaliser
            ),
            live=self.report.session.id,
            saves=True,
            threads=self.options.lane_threads(maps=True),
            clock=self.report.session,
        )


def _made_by(sequence: DriveSequence, settings: Settings) -> tuple[DescriptorKind, str]:
    """Kind of descriptor and hash of the front-end; a frame log states its own."""
    if isinstance(sequence, FrameLog):
        return sequence.header.descriptor, sequence.header.frontend
    return settings.frontend.descriptor, Frontend(settings.frontend).hash
