"""Mapping a whole drive: open or resume its session, feed the mapper, commit."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram import __version__
from engram.config import to_dict
from engram.errors import ConfigError
from engram.frontend import DescriptorKind, Frame, Frontend
from engram.geometry import StereoCamera
from engram.graph.model import PathEntryKind, Session
from engram.localiser import Budget, ByAppearance, FrameMatcher, Localiser, Position
from engram.mapper import LoopConfig, LoopSearch, Mapper, NodeWords, Saver
from engram.maps import Map, SessionState, SessionWriter, StoredSession, open_map
from engram.monitor import ignore
from engram.places import RECOGNISERS, hash_of
from engram.places.stored_words import keep_missing_words, vocabulary_or_default
from engram.ranking import check_for_robot
from engram.robot.live import LiveFrame, live_frames
from engram.robot.localisers import drives_of, localiser_in
from engram.robot.results import FrameResult, damage_warning, summarise
from engram.robot.session import DriveSequence, session_of_drive
from engram.robot.settings import Settings
from engram.sequences import FrameLog


@dataclass(frozen=True, slots=True)
class MapOptions:
    """How a drive is mapped.

    Attributes:
        policy: key of `POLICIES`.
        lanes, rounds: the budget of each frame.
        deadline_ms: deadline of each frame; None maps with counts alone, so that the same input
            gives the same map.
        relocaliser: key of `RELOCALISERS`.
        author: who maps; None for the robot.
        rate_hz: replay in real time; None for as fast as it goes.
        threads: whether the lanes run on threads; without a deadline the map is the same.
    """

    policy: str = "recall"
    lanes: int = 2
    rounds: int = 2
    deadline_ms: float | None = None
    relocaliser: str | None = "fabmap"
    author: str | None = None
    rate_hz: float | None = None
    threads: bool = True


@dataclass(slots=True)
class MapReport:
    """What mapping a drive came to.

    Attributes:
        session: the drive.
        revision: number of the revision that holds it; None if it was interrupted.
        known: whether the map held this very drive already; then nothing was done.
        resumed: whether it went on where an earlier run had stopped.
        interrupted: whether it was stopped; what was done is saved, and can be resumed.
        saved: nodes added.
        skipped: pairs left out under `skip_bad`.
        results: one per live frame.
    """

    session: Session
    revision: int | None = None
    known: bool = False
    resumed: bool = False
    interrupted: bool = False
    saved: int = 0
    skipped: int = 0
    results: list[FrameResult] = field(default_factory=list)

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
            **summarise(self.results),
        }

    def text(self) -> str:
        """For people."""
        if self.known:
            return f"session {self.session.id} is in the map already: nothing to do"
        summary = summarise(self.results)
        how = "resumed, " if self.resumed else ""
        line = (
            f"{how}{summary['frames']} frames over {summary['driven_m']:.1f} m: "
            f"{summary['share_localised']:.1%} localised, {self.saved} nodes saved"
        )
        if self.skipped:
            line += f", {self.skipped} pairs skipped"
        if summary["damaged_nodes"]:
            line = f"{damage_warning(summary['damaged_nodes'])}\n{line}"
        if self.interrupted:
            return f"{line}\ninterrupted: what was done is saved; give the same command to resume"
        return f"{line}, revision {self.revision}"


def map_drive(
    map_path: Path,
    sequence: DriveSequence,
    settings: Settings,
    options: MapOptions,
    advance: Callable[[str], None] = ignore,
    start: Callable[[Map], Position | None] | None = None,
    descriptor: str | None = None,
) -> MapReport:
    """Adds a drive to a map, which is made if there is none.

    A drive that the map holds already changes nothing; one that was interrupted is resumed.
    Ctrl-C ends it with what was done saved.

    Args:
        map_path: NAME.engram.
        sequence: the drive.
        settings: the resolved configuration, kept with the revision.
        options: how it is mapped.
        advance: called once per frame with a word on how it went.
        start: asked, with the map open, where the robot stands before its first frame; None where
            nobody knows. A drive that is resumed knows better.
        descriptor: kind of descriptor that somebody insists on; None for the frame log's, the
            map's or that of the settings, whichever is known first.

    Raises:
        ConfigError: the policy is unknown, or looks ahead; or the frame log or the map has another
            kind of descriptor than was insisted on.
        MapError: the map cannot be read or written; what was checkpointed is intact.
        SequenceError: the drive's images cannot be used; what came before is saved.
    """
    check_for_robot(options.policy)
    if descriptor is not None and isinstance(sequence, FrameLog):
        mend = f"record it again with --descriptor {descriptor}"
        _check_descriptor(descriptor, sequence.header.descriptor, sequence.info.name, mend)
    session = session_of_drive(sequence)
    report = MapReport(session)
    with open_map(map_path, create=True) as store, store.writing():
        if descriptor is not None:
            mend = "map the drive into another map"
            _check_descriptor(descriptor, store.descriptor, str(map_path), mend)
        state = store.session_state(session.id)
        if state is SessionState.COMMITTED:
            report.known = True
            return report
        settings = settings.for_descriptor(store.descriptor)
        if state is SessionState.ABSENT:
            writer = _begin(store, session, sequence, settings, options)
        else:
            writer = store.resume_session(session.id)
            report.resumed = True
        store.derived(drives_of)[session.id] = session
        words = _node_words(store, settings, options)
        with closing(live_frames(sequence, settings, options.rate_hz)) as frames:
            _map_frames(
                store,
                writer,
                sequence.camera,
                frames,
                settings,
                options,
                report,
                advance,
                None if start is None or report.resumed else start(store),
                words,
            )
    report.skipped = sequence.skipped
    return report


def _check_descriptor(asked: str, found: DescriptorKind | None, what: str, mend: str) -> None:
    """What somebody insists on is not passed over in silence.

    Raises:
        ConfigError: there is another kind already.
    """
    if found is not None and found != asked:
        raise ConfigError(
            f"{what} has {found} descriptors, not {asked} as --descriptor asks for; leave that "
            f"out, or {mend}"
        )


def _begin(
    store: Map,
    session: Session,
    sequence: DriveSequence,
    settings: Settings,
    options: MapOptions,
) -> SessionWriter:
    """A new session; frame logs tell which front-end made them."""
    if isinstance(sequence, FrameLog):
        descriptor, frontend = sequence.header.descriptor, sequence.header.frontend
    else:
        descriptor, frontend = settings.frontend.descriptor, Frontend(settings.frontend).hash
    return store.begin_session(
        session,
        sequence.camera,
        descriptor=descriptor,
        frontend=frontend,
        author=options.author or session.robot,
        configuration=_configuration(settings, options),
        message=f"map {sequence.info.name}",
    )


def _configuration(settings: Settings, options: MapOptions) -> dict[str, Any]:
    """The resolved configuration, which every revision keeps (STYLE: reproducible)."""
    return {
        "settings": to_dict(settings),
        "options": to_dict(options),
        "machine": platform.machine(),
        "engram": __version__,
    }


def _map_frames(
    opened: Map,
    writer: SessionWriter,
    camera: StereoCamera,
    frames: Iterable[LiveFrame],
    settings: Settings,
    options: MapOptions,
    report: MapReport,
    advance: Callable[[str], None],
    start: Position | None,
    words: NodeWords | None,
) -> None:
    """Feeds the mapper; commits at the end, or leaves the session to be resumed."""
    saver = Saver(writer, opened.frames, settings.mapper.checkpoint_every, words)
    localiser = localiser_in(
        opened,
        camera,
        settings,
        policy=options.policy,
        budget=Budget(options.lanes, options.rounds, deadline_ms=options.deadline_ms),
        relocaliser=options.relocaliser,
        live=writer.session.id,
        saves=True,
        threads=options.threads,
        clock=writer.session,
    )
    if start is not None:
        localiser.start_at(start)
    stored = writer.stored
    if stored.last_entry is not None:
        localiser.resume_walk(stored.last_entry.node, stored.next_sequence, stored.next_iteration)
    with localiser, loop_search(opened, localiser, settings) as loops:
        mapper = Mapper(opened.graph, localiser, saver, writer.session, settings.mapper, loops)
        try:
            for live in _from_where_it_stopped(frames, stored, mapper, advance):
                deadline = (
                    None
                    if options.deadline_ms is None
                    else live.arrived + options.deadline_ms / 1e3
                )
                step = mapper.process(live.frame, live.motion, deadline)
                report.saved += step.saved is not None
                report.results.append(
                    FrameResult(
                        step.localisation,
                        live.motion.odometry.prev_from_curr,
                        {**live.stage_ms, **step.localisation.stage_ms},
                    )
                )
                word = "saved" if step.saved else step.localisation.status.value
                advance(word)
            mapper.finish()
        except KeyboardInterrupt:
            report.interrupted = True
        finally:
            saver.finish()
    if not report.interrupted:
        report.revision = writer.commit().number


def _node_words(opened: Map, settings: Settings, options: MapOptions) -> NodeWords | None:
    """How the words of saved nodes are found; those that older nodes lack are filled in first."""
    if options.relocaliser not in RECOGNISERS:
        return None
    descriptor = settings.frontend.descriptor
    vocabulary = vocabulary_or_default(opened, descriptor)
    keep_missing_words(opened, vocabulary, [node.id for node in opened.graph.nodes])

    def words_of(frame: Frame) -> NDArray[np.int32]:
        return vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)

    return NodeWords(hash_of(vocabulary), words_of)


def loop_search(
    opened: Map, localiser: Localiser, settings: Settings
) -> AbstractContextManager[LoopSearch | None]:
    """Looks for loops by the words that the relocaliser knows; None where it knows none."""
    finder = localiser.relocaliser
    if not isinstance(finder, ByAppearance):
        return nullcontext()
    matching = settings.localiser
    return LoopSearch(
        opened.graph,
        finder.book,
        FrameMatcher(opened.frames, matching.matcher),
        matching.acceptance,
        LoopConfig(near_m=matching.search_radius_m, own_exclusion_m=matching.own_exclusion_m),
    )


def _from_where_it_stopped(
    frames: Iterable[LiveFrame],
    stored: StoredSession,
    mapper: Mapper,
    advance: Callable[[str], None],
) -> Iterable[LiveFrame]:
    """All frames of a new session; of a resumed one those after the last that it remembers.

    That is the frame of its last saved node or of its last match, whichever is later; frames up
    to there went into the map already, and give odometry only.
    """
    for live in frames:
        stamp_ns = live.frame.stamp_ns
        if stored.last_stamp_ns is None or stamp_ns > stored.last_stamp_ns:
            yield live
            continue
        advance("resuming")
        mapper.follow(live.motion)
        if stored.nodes and stamp_ns == stored.nodes[-1].stamp_ns:
            mapper.resume_in(stored.nodes[-1].id)
        entry = stored.last_entry
        if entry and stamp_ns == entry.stamp_ns and entry.kind is PathEntryKind.MATCHED:
            mapper.resume_near(entry.node)
