"""Saving a drive: begun or resumed, written next to the robot's loop, committed or left.

There is one way to save a drive, over two sinks: a revision of the map, which takes nodes, and a
spool next to the map (`engram.robot.spool`), which takes path and attempts alone.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import count
from pathlib import Path
from typing import Any

from engram import __version__
from engram.config import to_dict
from engram.doctor.table import Finding
from engram.errors import MapError, MapLockedError
from engram.frontend.frame import DescriptorKind, Frame, StereoPair
from engram.frontend.frontend import Frontend
from engram.geometry.cameras import StereoCamera
from engram.graph.model import Clock, Node, NodeId, PathEntry, Removal, Session, SessionId, path_id
from engram.graph.placing import PlacingConfig
from engram.localiser.acceptance import Rule
from engram.localiser.attempts import Attempter, Lanes
from engram.localiser.localisation import NO_SINK, ResultSink
from engram.localiser.localiser import UNNAMED_LIVE_SESSION, Localiser
from engram.localiser.relocalisation import ByAppearance, Suggested
from engram.localiser.yardstick import Yardstick
from engram.mapper.loops import LoopConfig, LoopSearch
from engram.mapper.mapper import Mapper, Memory, Records, Saver
from engram.maps.frame_reader import FrameReader
from engram.maps.map import Map
from engram.maps.records import Revision, StoredSession
from engram.maps.writer import RevisionWriter
from engram.places.recognisers import recogniser_names
from engram.places.words import NodeWords, words_of
from engram.ranking.context import RankingPolicy
from engram.robot.anchors import NewestFix, suggesting
from engram.robot.front import Arrived
from engram.robot.localisers import DriveSequence, drives_of, localiser_in
from engram.robot.settings import RobotOptions, Settings
from engram.robot.spool import SessionHeader, Spool
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.sequence import LoggedFrame, SequenceInfo, first_pair_hash, session_of

# Stamps from here (1973) on come from a clock; smaller ones count from the robot's start.
_CLOCK_FROM_NS = 10**17


@dataclass(frozen=True, slots=True)
class RobotSetup:
    """A robot and its drive, before it is opened in a map.

    Attributes:
        name: name of the robot; None for one that saves nothing.
        session: the drive, if known before the first frame.
        fix: the newest satellite fix at a time, near which nodes are proposed; None for none.
        known: sessions of the map, where a drive that was interrupted may be played again: what
            comes is another session.
    """

    camera: StereoCamera
    settings: Settings
    options: RobotOptions
    name: str | None = None
    session: Session | None = None
    fix: NewestFix | None = None
    policy: RankingPolicy | None = None
    known: frozenset[SessionId] = frozenset()

    def localiser_in(
        self, opened: Map, *, maps: bool = False, remembers: bool = False
    ) -> Localiser:
        """The localiser of the drive."""
        options = self.options
        if options.memory_bytes is not None:
            opened.bound_memory(options.memory_bytes)
        graph = opened.read_graph()
        finder = suggesting(opened, self.fix, self.settings, options.relocaliser, graph)
        return localiser_in(
            opened,
            self.camera,
            self.settings,
            policy=self.policy or options.ranking,
            budget=options.budget,
            relocaliser=finder,
            graph=graph,
            live=UNNAMED_LIVE_SESSION if self.session is None else self.session.id,
            saves=maps,
            threads=options.lane_threads(maps=maps, remembers=remembers),
            clock=self.session,
        )

    def session_from(self, first: Arrived) -> Session:
        """The session that begins with this pair or logged frame."""
        if self.session is not None:
            return self.session
        pair = first if isinstance(first, StereoPair) else first.frame
        clock = Clock.UTC if pair.stamp_ns >= _CLOCK_FROM_NS else Clock.RELATIVE
        info = SequenceInfo(self.name or "live", "live", clock, self.name)
        pixels = first_pair_hash(first) if isinstance(first, StereoPair) else ""
        again = (pixels if n == 1 else f"{pixels}-{n}" for n in count(1))
        made = (session_of(info, self.camera, pair.stamp_ns, one) for one in again)
        return next(session for session in made if session.id not in self.known)

    def header(
        self,
        session: Session,
        source: Arrived | DriveSequence,
        message: str,
        **configuration: Any,
    ) -> SessionHeader:
        """The header of the drive's session.

        Args:
            source: its images or frame log; a frame log states its own front-end.
            message: text for ``log``.
        """
        descriptor, frontend = _front_end_of(source, self.settings)
        resolved = {
            "settings": to_dict(self.settings),
            "options": to_dict(self.options),
            "machine": platform.machine(),
            "engram": __version__,
        }
        author = self.options.author or session.robot
        return SessionHeader(
            session,
            self.camera,
            descriptor,
            frontend,
            {**resolved, **configuration},
            message,
            author,
        )


def _front_end_of(
    source: Arrived | DriveSequence, settings: Settings
) -> tuple[DescriptorKind, str]:
    """Kind of descriptors, and hash of the front-end."""
    if isinstance(source, LoggedFrame):
        return source.frame.descriptor, source.frame.frontend
    if isinstance(source, FrameLog):
        return source.header.descriptor, source.header.frontend
    return settings.frontend.descriptor, Frontend(settings.frontend).hash


@dataclass(frozen=True, slots=True)
class RevisionSink:
    """The revision of a map that a drive is mapped in; a `Sink`.

    Attributes:
        frames: keeps frames readable until they are written.
        words: finds the words stored with saved nodes; None stores none.
        placing: how nodes are laid out in the map frame.
    """

    writer: RevisionWriter
    frames: FrameReader
    words: NodeWords | None
    placing: PlacingConfig

    def hold(self, node: NodeId, frame: Frame) -> None:
        """See `Sink`."""
        self.frames.hold(node, frame)

    def add(self, records: Records, entry: PathEntry | None) -> None:
        """See `Sink`; stores the words of a node with it."""
        if records.node is not None and records.frame is not None:
            self.writer.add_node(records.node, records.frame)
            if self.words is not None:
                found = self.words.of_frame(records.frame)
                self.writer.add_words(records.node.id, self.words.hash, found)
        for edge in records.edges:
            self.writer.add_edge(edge)
        if entry is not None:
            self.writer.add_path_entry(entry)
        if records.attempts:
            self.writer.add_attempts(records.attempts)

    def checkpoint(self) -> None:
        """See `Sink`."""
        self.writer.checkpoint()

    def close(self) -> None:
        """Nothing to release: the map stays open."""

    def commit(self, removals: Sequence[Removal] = ()) -> Revision:
        """Commits the revision, without the edges that the drive's fixes disproved."""
        for removal in removals:
            self.writer.add_mark(removal)
        return self.writer.commit(self.placing)

    def leave(self) -> None:
        """Leaves the session uncommitted, for ``engram check --seal`` alone."""
        self.writer.leave()


class DriveSession:
    """One drive that is being saved, on its own thread. Made by `mapped` and `remembered`."""

    def __init__(
        self,
        localiser: Localiser,
        result_sink: Memory,
        saver: Saver,
        sink: RevisionSink | Spool,
        loops: AbstractContextManager[object] | None = None,
    ) -> None:
        self.localiser = localiser
        self.result_sink = result_sink
        self._saver = saver
        self._sink = sink
        self._loops = nullcontext() if loops is None else loops

    @staticmethod
    def mapped(
        opened: Map,
        writer: RevisionWriter,
        localiser: Localiser,
        settings: Settings,
        words: NodeWords | None,
        *,
        waits: bool = True,
    ) -> DriveSession:
        """A drive that is mapped.

        Args:
            opened: the map, open for writing; its graph grows.
            writer: writer of the session, begun or resumed.
            localiser: localiser of the drive, in the same map.
            settings: settings of the mapper and the map frame.
            words: finds the words of nodes, see `node_words`.
            waits: whether a slow disk slows the drive; else it ends the saving.
        """
        session, stored, mapper = writer.session, writer.stored, settings.mapper
        opened.derived(drives_of)[session.id] = session
        sink = RevisionSink(writer, opened.frames, words, settings.placing)
        loops = loop_search(opened, localiser, settings, stored.nodes)
        saver = Saver(
            sink, path_id(session.id), mapper.checkpoint_every, waits=waits, last=stored.last_entry
        )
        result_sink = Mapper(localiser.graph, localiser, saver, session, mapper, loops, stored)
        return DriveSession(localiser, result_sink, saver, sink, loops)

    @staticmethod
    def remembered(
        map_path: Path, header: SessionHeader, localiser: Localiser, settings: Settings
    ) -> DriveSession:
        """A drive of which only path and attempts are saved."""
        sink = Spool(map_path, header, settings.mapper.memory_bytes)
        every = settings.mapper.checkpoint_every
        saver = Saver(sink, path_id(header.session.id), every, waits=False)
        return DriveSession(localiser, Memory(localiser, saver), saver, sink)

    @property
    def location(self) -> str:
        """Where what it saves waits until it is committed."""
        return str(self._sink.path) if isinstance(self._sink, Spool) else ""

    def finish(self) -> None:
        """Ends the drive and saves what its last frames still add."""
        self.result_sink.finish()

    def close(self) -> None:
        """Writes what is queued, and ends the threads. A mapped session can be resumed."""
        try:
            with self._loops:
                self._saver.finish()
        finally:
            self._sink.close()

    def commit(self) -> Revision | None:
        """Makes the drive a revision of the map; None if it adds nothing.

        Raises:
            MapLockedError: another process writes to the map: the spool waits.
        """
        return self._sink.commit(self.result_sink.removals)

    def leave(self) -> None:
        """Leaves the drive uncommitted: a mapped one for ``engram check --seal``, no other."""
        self._sink.leave()


class SavingState(StrEnum):
    """State of the saving of a live drive."""

    OFF = "off"
    ON = "on"
    FAILED = "failed"
    SPOOLED = "spooled"
    COMMITTED = "committed"
    UNCOMMITTED = "uncommitted"


@dataclass(slots=True)
class Saving:
    """Whether and where a live drive is saved.

    Attributes:
        state: `FAILED` after a write error: the robot continues to localise, and what it had saved
            is kept; `SPOOLED` if another process writes to the map, so that the drive's memory
            waits in a file next to it; `UNCOMMITTED` if the doctor found something fatal: a mapped
            session then waits for ``engram check --seal``.
        reason: why saving failed or was not committed, or where the memory waits.
        revision: number of the revision that holds the drive.
        recovered: revisions that hold what earlier drives of the robot had saved when their process
            was killed.
    """

    state: SavingState = SavingState.OFF
    reason: str = ""
    session: SessionId | None = None
    revision: int | None = None
    nodes: int = 0
    recovered: tuple[int, ...] = ()

    def text(self) -> str:
        """For people."""
        earlier = ", ".join(map(str, self.recovered))
        said = f"; what was saved before an interruption: revision {earlier}" if earlier else ""
        return self._state_text() + said

    def _state_text(self) -> str:
        match self.state:
            case SavingState.COMMITTED if self.revision is None:
                return "the map already remembers this drive, or there was nothing to remember"
            case SavingState.COMMITTED:
                return f"kept as revision {self.revision}"
            case SavingState.SPOOLED:
                return (
                    f"another process writes to the map: the drive waits in {self.reason}; the "
                    "next run that maps or remembers commits it"
                )
            case SavingState.FAILED:
                return f"saving failed: {self.reason}"
            case SavingState.UNCOMMITTED:
                kept = "; engram check --seal commits what was mapped anyway" if self.nodes else ""
                return f"not committed, because the drive is unfit: {self.reason}{kept}"
        return f"saving is {self.state}"


def commit_crashed(opened: Map, robot: str, settings: Settings) -> tuple[int, ...]:
    """Commits what earlier live drives of a robot had saved before their process ended.

    Drives that `engram map` was mapping stay as they are: it resumes them. So do those that the
    doctor found unfit.

    Args:
        opened: the map; sees the new revisions.
        settings: how the map frame is laid out.

    Returns:
        Numbers of the revisions.

    Raises:
        MapLockedError: another process writes to the map.
    """
    waiting = [one for one in opened.interrupted() if one.live and one.pid]
    mine = [hypothesis.session.id for hypothesis in waiting if hypothesis.session.robot == robot]
    if not mine:
        return ()
    numbers = []
    with Map.open(opened.location, writes=True) as own:
        for session in mine:
            writer = own.resume_session(session)
            if writer.stored == StoredSession():
                writer.abandon()  # it ended before it had saved anything
            else:
                numbers.append(writer.commit(settings.placing).number)
    with opened.writing():
        pass  # shows it the newest revision
    return tuple(numbers)


def node_words(opened: Map, settings: Settings, relocaliser: str | None) -> NodeWords | None:
    """Finds the words of saved nodes; first adds those missing from older nodes."""
    if relocaliser not in recogniser_names():
        return None
    words = opened.derived(words_of, settings.frontend.descriptor)
    words.keep_missing()
    return words


def loop_search(
    opened: Map, localiser: Localiser, settings: Settings, saved: Sequence[Node] = ()
) -> LoopSearch | None:
    """Loop search by the words of the relocaliser; None if it has none.

    Args:
        saved: what an interrupted run had saved.
    """
    finder = localiser.relocaliser
    if isinstance(finder, Suggested):
        finder = finder.inner
    if not isinstance(finder, ByAppearance):
        return None
    matching = settings.localiser
    attempter = Attempter(opened.frames, matching, Lanes(opened.frames, matching.matcher))
    told = matching.lookalikes.doubt > 0 and matching.acceptance.rule is Rule.CONFIDENCE
    return LoopSearch(
        localiser.graph,
        finder.book,
        attempter,
        matching.acceptance,
        LoopConfig(near_m=matching.search_radius_m, own_exclusion_m=matching.own_exclusion_m),
        Yardstick(localiser.graph, attempter.frame, matching.matcher) if told else None,
        saved,
    )


class LiveDrive:
    """A live drive: begun by its first frame, kept until an error or the doctor ends that.

    Nothing here forwards to the result sink: the robot asks the one that each method returns, and
    after a write error or an unfit drive that is one that keeps nothing.

    Args:
        opened: the map; the robot's own view of it, which grows, if it maps.
        maps: whether nodes are saved, or only path and attempts.
        saving: whether anything is kept, and the outcome of earlier drives; None to begin.
    """

    def __init__(
        self, setup: RobotSetup, opened: Map, *, maps: bool, saving: Saving | None = None
    ) -> None:
        self.saving = saving or Saving(SavingState.ON)
        self._setup = setup
        self._opened = opened
        self._maps = maps
        self._words: NodeWords | None = None
        self._session: DriveSession | None = None
        with ExitStack() as stack:
            if maps:
                stack.enter_context(opened)
                stack.enter_context(opened.writing())
                self._words = node_words(opened, setup.settings, setup.options.relocaliser)
            self.localiser = setup.localiser_in(opened, maps=maps, remembers=not maps)
            self._stack = stack.pop_all()

    def begin(self, first: Arrived) -> ResultSink:
        """Begins the drive with this pair or logged frame; returns its result sink."""
        session, result_sink = self._setup.session_from(first), NO_SINK
        self.saving.session = session.id
        try:
            if self.saving.state is not SavingState.FAILED:
                self._session = self._begun(session, first)
                result_sink = self._session.result_sink
        except MapError as error:
            result_sink = self.failed(error)
        if self.saving.state is SavingState.FAILED:
            # The map may hold this very drive: its nodes are then not the robot's own.
            session = replace(session, id=UNNAMED_LIVE_SESSION)
        self.localiser.begin(session)
        return result_sink

    def _begun(self, session: Session, first: Arrived) -> DriveSession:
        setup, settings, opened = self._setup, self._setup.settings, self._opened
        if not self._maps:
            header = setup.header(session, first, f"memory of {session.robot}")
            map_path = Path(opened.location)
            return DriveSession.remembered(map_path, header, self.localiser, settings)
        header = setup.header(session, first, f"map {session.robot}", live=True)
        writer = header.begin(opened)
        return DriveSession.mapped(
            opened, writer, self.localiser, settings, self._words, waits=False
        )

    def failed(self, error: MapError) -> ResultSink:
        """A write failed: ends the saving, not the drive; returns the result sink from now on."""
        self.saving.state, self.saving.reason = SavingState.FAILED, str(error)
        return NO_SINK

    def examined(self, fatal: Sequence[Finding], result_sink: ResultSink) -> ResultSink:
        """The result sink from now on: a drive that the doctor found unfit is not committed.

        Args:
            result_sink: the one until now.
        """
        if not fatal or self._setup.options.force or self.saving.state is not SavingState.ON:
            return result_sink
        try:
            self._leave(fatal)
        except MapError as error:
            return self.failed(error)
        return NO_SINK

    def close(self, fatal: Sequence[Finding] = ()) -> None:
        """Ends the drive and commits it as a revision, unless the doctor found it unfit.

        What was written before a write error is committed all the same.
        """
        failed = self.saving.state is SavingState.FAILED
        try:
            if fatal and not self._setup.options.force:
                self._leave(fatal)
            else:
                self._commit()
        except MapError as error:
            if not failed:
                self.failed(error)
                raise
        finally:
            self._stack.close()

    def _commit(self) -> None:
        session, saving = self._ended(), self.saving
        if session is None:
            return
        try:
            revision = session.commit()
        except MapLockedError:
            saving.state, saving.reason = SavingState.SPOOLED, session.location
            return
        if revision is not None:
            saving.revision = revision.number
        if saving.state is not SavingState.FAILED:
            saving.state = SavingState.COMMITTED

    def _leave(self, fatal: Sequence[Finding]) -> None:
        session = self._ended()
        if session is not None:
            session.leave()
        if self.saving.state is not SavingState.FAILED:
            self.saving.state = SavingState.UNCOMMITTED
            self.saving.reason = "; ".join(finding.message for finding in fatal)

    def _ended(self) -> DriveSession | None:
        """The session, once all that it saved is written; None if none has begun."""
        session, self._session = self._session, None
        if session is None:
            return None
        well = self.saving.state is not SavingState.FAILED
        try:
            try:
                if well:
                    session.finish()
            finally:
                session.close()
        except MapError:
            if well:
                raise
        return session
