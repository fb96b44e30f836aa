"""Saving a drive: in a map or next to it, live without delaying the robot's loop.

A drive's memory in a file next to the map, until the map's writer is free. A robot that only
remembers needs the map's writer at the end of its drive, not throughout: others may map meanwhile.
So its path and attempts go to a separate file, which also survives a crash. The next process that
finds the writer free commits them as a session.

The file is a sequence of chunks: length and CRC-32 of the body, each a little-endian uint32, then
the body, compressed MessagePack. The first chunk is the header. A chunk torn by a crash ends the
file.
"""

from __future__ import annotations

import fcntl
import glob
import os
import platform
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import asdict, astuple, dataclass, replace
from enum import StrEnum
from itertools import count
from pathlib import Path
from typing import IO, Any, Protocol
from uuid import UUID

import msgspec

from engram import __version__
from engram.config import to_dict
from engram.doctor.table import Finding
from engram.errors import MapCorruptError, MapError, MapLockedError, storage_full
from engram.frontend.frame import DescriptorKind, StereoPair
from engram.frontend.frontend import Frontend
from engram.geometry.cameras import StereoCamera
from engram.graph.model import (
    Attempt,
    Clock,
    NodeId,
    PathEntry,
    PathEntryKind,
    Session,
    SessionId,
    path_id,
)
from engram.localiser.acceptance import Rule
from engram.localiser.attempts import Attempter, FrameMatcher
from engram.localiser.localisation import KEEPS_NOTHING, Keeper
from engram.localiser.localiser import UNNAMED_LIVE_SESSION, Localiser
from engram.localiser.relocalisation import ByAppearance, Relocaliser, Suggested
from engram.localiser.yardstick import Yardstick
from engram.mapper.loops import LoopConfig, LoopSearch
from engram.mapper.mapper import Mapper, Memory, NodeSaver, Saver
from engram.maps.map import Map, open_map
from engram.maps.records import Revision, SessionState, StoredSession
from engram.maps.rows import camera_from_row, camera_row
from engram.maps.writer import RevisionWriter
from engram.places.recognisers import RECOGNISERS
from engram.places.words import NodeWords, words_of
from engram.robot.front import Arrived
from engram.robot.localisers import drives_of, localiser_in
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.sequence import SequenceInfo, first_pair_hash, session_of


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
        session: the drive.
        revision: number of the revision that holds the drive.
        nodes: number of saved nodes.
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


class SavedDrive:
    """Saves one drive with a mapper, on its own thread, and commits it.

    Args:
        opened: the map, open for writing; its graph grows.
        writer: writer of the session.
        localiser: localiser of the drive, in the same map.
        settings: settings of the mapper and the map frame.
        words: finds the words of nodes, see `node_words`.
        waits: whether a slow disk slows the drive; else it ends the saving.

    Attributes:
        mapper: the drive's keeper.
    """

    def __init__(
        self,
        opened: Map,
        writer: RevisionWriter,
        localiser: Localiser,
        settings: Settings,
        words: NodeWords | None,
        *,
        waits: bool = True,
    ) -> None:
        opened.derived(drives_of)[writer.session.id] = writer.session
        self._writer, self._placing = writer, settings.placing
        every = settings.mapper.checkpoint_every
        self._saver = Saver(writer, NodeSaver(writer, opened.frames, words), every, waits)
        self._stack = ExitStack()
        loops = self._stack.enter_context(loop_search(opened, localiser, settings))
        self.mapper = Mapper(
            localiser.graph,
            localiser,
            self._saver,
            writer.session,
            settings.mapper,
            loops,
            writer.stored,
        )

    def finish(self) -> None:
        """Ends the drive and saves what its last frames still add."""
        self.mapper.finish()

    def close(self) -> None:
        """Writes what is queued, and ends the threads. The session can be resumed.

        Raises:
            MapError: a write failed.
        """
        with self._stack:
            self._saver.finish()

    def commit(self) -> Revision:
        """Makes the session a revision of the map, without the edges that its fixes disproved."""
        for removal in self.mapper.votes.removals:
            self._writer.add_mark(removal)
        return self._writer.commit(self._placing)

    def leave(self) -> None:
        """Leaves the session uncommitted, for ``engram check --seal`` alone."""
        self._writer.leave()


def commit_crashed(opened: Map, robot: str, settings: Settings) -> tuple[int, ...]:
    """Commits what earlier live drives of a robot had saved before their process ended.

    Drives that `engram map` was mapping stay as they are: it resumes them. So do those that the
    doctor found unfit.

    Args:
        opened: the map; sees the new revisions.
        robot: name of the robot.
        settings: how the map frame is laid out.

    Returns:
        Numbers of the revisions.

    Raises:
        MapLockedError: another process writes to the map.
        MapError: it cannot be written.
    """
    waiting = [one for one in opened.interrupted() if one.live and one.pid]
    mine = [one.session.id for one in waiting if one.session.robot == robot]
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


def configuration_of(settings: Settings, options: RobotOptions) -> dict[str, Any]:
    """The resolved configuration, which every revision keeps."""
    return {
        "settings": to_dict(settings),
        "options": to_dict(options),
        "machine": platform.machine(),
        "engram": __version__,
    }


def node_words(opened: Map, settings: Settings, relocaliser: str | None) -> NodeWords | None:
    """Finds the words of saved nodes; first adds those missing from older nodes."""
    if relocaliser not in RECOGNISERS:
        return None
    words = opened.derived(words_of, settings.frontend.descriptor)
    words.keep_missing([node.id for node in opened.graph.nodes])
    return words


def loop_search(
    opened: Map, localiser: Localiser, settings: Settings
) -> LoopSearch | nullcontext[None]:
    """Loop search by the words of the relocaliser; a null context if it has none."""
    finder = localiser.relocaliser
    if isinstance(finder, Suggested):
        finder = finder.inner
    if not isinstance(finder, ByAppearance):
        return nullcontext()
    matching = settings.localiser
    attempter = Attempter(opened.frames, matching, FrameMatcher(opened.frames, matching.matcher))
    told = matching.lookalikes.doubt > 0 and matching.acceptance.rule is Rule.CONFIDENCE
    return LoopSearch(
        localiser.graph,
        finder.book,
        attempter,
        matching.acceptance,
        LoopConfig(near_m=matching.search_radius_m, own_exclusion_m=matching.own_exclusion_m),
        Yardstick(localiser.graph, attempter.frame, matching.matcher) if told else None,
    )


_CHUNK = struct.Struct("<II")
_VERSION = 1


class Spool:
    """Writes one drive's memory; a `PathWriter` of a session without nodes.

    Args:
        map_path: the map; the file lies next to it.
        session: the drive.
        camera: its camera.
        made_by: kind of its descriptors, and hash of the front-end.
        configuration: kept with the revision.
        most_bytes: largest size; later records are dropped.

    Raises:
        MapError: the file cannot be written.
    """

    def __init__(
        self,
        map_path: Path,
        session: Session,
        camera: StereoCamera,
        made_by: tuple[DescriptorKind, str],
        configuration: dict[str, Any],
        most_bytes: int,
    ) -> None:
        self.path = map_path.with_name(f"{map_path.name}-memory-{session.id}")
        self._most_bytes = most_bytes
        self._entries: list[PathEntry] = []
        self._attempts: list[Attempt] = []
        with _as_map_errors(self.path):
            self._file: IO[bytes] = _opened(self.path, os.O_CREAT | os.O_RDWR | os.O_TRUNC)
        self._append(
            {
                "version": _VERSION,
                "session": asdict(session),
                "camera": camera_row(camera, 0),
                "descriptor": made_by[0],
                "frontend": made_by[1],
                "configuration": configuration,
            }
        )

    @property
    def full(self) -> bool:
        """Whether it has reached its largest size and drops further records."""
        return self._file.tell() >= self._most_bytes

    def add_path_entry(self, entry: PathEntry) -> None:
        """See `PathWriter`."""
        self._entries.append(entry)

    def add_attempts(self, made: list[Attempt]) -> None:
        """See `PathWriter`."""
        self._attempts += made

    def checkpoint(self) -> None:
        """See `PathWriter`."""
        if (self._entries or self._attempts) and not self.full:
            entries, attempts = ([astuple(x) for x in y] for y in (self._entries, self._attempts))
            self._append({"entries": entries, "attempts": attempts})
        self._entries, self._attempts = [], []

    def close(self) -> None:
        """Closes the file; from now on it may be committed."""
        self._file.close()

    def _append(self, content: dict[str, Any]) -> None:
        body = zlib.compress(msgspec.msgpack.encode(content))
        with _as_map_errors(self.path):
            self._file.write(_CHUNK.pack(len(body), zlib.crc32(body)) + body)
            self._file.flush()
            os.fsync(self._file.fileno())


def commit_spools(map_path: Path) -> dict[Path, Revision]:
    """Commits the memories next to a map, each as a session without nodes; returns the revisions.

    Memories of running drives are left alone. Entries and attempts of nodes that the map no longer
    shows are left out.

    Raises:
        MapLockedError: another process writes to the map; the memories wait.
        MapError: the map cannot be written, or a memory cannot be read.
    """
    spools = sorted(map_path.parent.glob(f"{glob.escape(map_path.name)}-memory-*"))
    if not spools:
        return {}
    committed = {}
    with open_map(map_path) as opened, opened.writing():
        for path in spools:
            with suppress(BlockingIOError, FileNotFoundError), _opened(path, os.O_RDONLY) as file:
                revision = _commit(opened, _chunks(file, path), path)
                path.unlink()
                if revision is not None:
                    committed[path] = revision
    return committed


def _commit(opened: Map, chunks: Iterator[dict[str, Any]], path: Path) -> Revision | None:
    """The revision; None if the memory is empty or already in the map."""
    header = next(chunks, None)
    if header is None:
        return None  # killed before the header was written
    if header["version"] != _VERSION:
        raise MapError(f"{path} was written by a newer Engram; upgrade to commit it")
    graph, session = opened.graph, _session(header["session"])
    entries, attempts = list[PathEntry](), list[Attempt]()
    for chunk in chunks:
        found = (_entry(session, row) for row in chunk["entries"])
        entries += [one for one in found if one.node in graph]
        made = (_attempt(row) for row in chunk["attempts"])
        attempts += [one for one in made if one.reference in graph and one.node in graph]
    state = opened.session_state(session.id)
    if state is SessionState.COMMITTED or not (entries or attempts):
        return None
    if state is SessionState.INTERRUPTED:
        writer = opened.resume_session(session.id)
    else:
        writer = opened.begin_session(
            session,
            camera_from_row(header["camera"]),
            descriptor=DescriptorKind(header["descriptor"]),
            frontend=header["frontend"],
            author=session.robot,
            configuration=header["configuration"],
            message=f"memory of {session.robot}",
        )
    for entry in entries:
        if entry.sequence >= writer.stored.next_sequence:
            writer.add_path_entry(entry)
    first = writer.stored.next_iteration
    writer.add_attempts([one for one in attempts if one.iteration >= first])
    return writer.commit()


def _entry(session: Session, row: list[Any]) -> PathEntry:
    _, sequence, node, kind, stamp_ns = row
    kind = PathEntryKind(kind)
    return PathEntry(path_id(session.id), sequence, NodeId(UUID(node)), kind, stamp_ns)


def _attempt(row: list[Any]) -> Attempt:
    iteration, reference, node, *rest = row
    return Attempt(iteration, NodeId(UUID(reference)), NodeId(UUID(node)), *rest)


def _session(values: dict[str, Any]) -> Session:
    fields = {**values, "id": SessionId(UUID(values["id"])), "clock": Clock(values["clock"])}
    return Session(**fields)


def _chunks(file: IO[bytes], path: Path) -> Iterator[dict[str, Any]]:
    """The intact chunks of a memory."""
    while len(head := file.read(_CHUNK.size)) == _CHUNK.size:
        length, checksum = _CHUNK.unpack(head)
        body = file.read(length)
        if len(body) < length or zlib.crc32(body) != checksum:
            return
        try:
            yield msgspec.msgpack.decode(zlib.decompress(body))
        except (msgspec.DecodeError, zlib.error) as error:
            raise MapCorruptError(f"{path} is not a memory of a drive: {error}") from error


def _opened(path: Path, flags: int) -> IO[bytes]:
    """A regular file, locked for this process.

    Raises:
        BlockingIOError: another process holds it.
    """
    file = os.fdopen(os.open(path, flags | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666),
                     "rb" if flags == os.O_RDONLY else "r+b")  # fmt: skip
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise
    return file


@contextmanager
def _as_map_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        full = storage_full(error, path)
        raise full or MapError(f"{path} cannot be written: {error.strerror}") from error


# Stamps from here (1973) on come from a clock; smaller ones count from the robot's start.
_CLOCK_FROM_NS = 10**17


@dataclass(frozen=True, slots=True)
class Owner:
    """The robot whose drive is kept.

    Attributes:
        name: name of the robot.
        camera: its camera.
        settings: the resolved configuration.
        options: how it localises.
        recorded: the session, if known before the first frame.
        finder: the relocaliser; None for that of the options.
        known: sessions of the map, where a drive that was interrupted may be played again: what
            comes is another session.
    """

    name: str | None
    camera: StereoCamera
    settings: Settings
    options: RobotOptions
    recorded: Session | None = None
    finder: str | Relocaliser | None = None
    known: frozenset[SessionId] = frozenset()

    def made_by(self, first: Arrived) -> tuple[DescriptorKind, str]:
        """Kind of descriptors and hash of the front-end, those of the log for a logged frame."""
        if isinstance(first, StereoPair):
            return self.settings.frontend.descriptor, Frontend(self.settings.frontend).hash
        return first.frame.descriptor, first.frame.frontend

    def localiser_in(
        self, opened: Map, *, saves: bool = False, remembers: bool = False
    ) -> Localiser:
        """The localiser of the drive; its session begins with the first frame.

        Raises:
            ConfigError: the robot has too few threads.
        """
        return localiser_in(
            opened,
            self.camera,
            self.settings,
            policy=self.options.ranking,
            budget=self.options.budget,
            relocaliser=self.finder or self.options.relocaliser,
            saves=saves,
            threads=self.options.lane_threads(maps=saves, remembers=remembers),
        )

    def session(self, first: Arrived) -> Session:
        """The session that begins with this pair or logged frame."""
        if self.recorded is not None:
            return self.recorded
        pair = first if isinstance(first, StereoPair) else first.frame
        clock = Clock.UTC if pair.stamp_ns >= _CLOCK_FROM_NS else Clock.RELATIVE
        info = SequenceInfo(self.name or "live", "live", clock, self.name)
        pixels = first_pair_hash(first) if isinstance(first, StereoPair) else ""
        again = (pixels if n == 1 else f"{pixels}-{n}" for n in count(1))
        made = (session_of(info, self.camera, pair.stamp_ns, one) for one in again)
        return next(one for one in made if one.id not in self.known)


class Into(Protocol):
    """Where the nodes of a live drive are saved."""

    @property
    def localiser(self) -> Localiser:
        """The localiser of the drive."""
        ...

    def begin(self, session: Session, made_by: tuple[DescriptorKind, str]) -> Keeper:
        """Begins the drive; returns its keeper.

        Args:
            session: the drive.
            made_by: kind of its descriptors, and hash of the front-end.

        Raises:
            MapError: the session cannot be begun.
        """
        ...

    def end(self, saving: Saving, *, well: bool) -> None:
        """Commits the drive as a revision.

        Args:
            saving: receives the outcome.
            well: whether everything was written so far.

        Raises:
            MapError: it cannot be written.
        """
        ...

    def leave(self, *, well: bool) -> None:
        """Ends an unfit drive without committing it.

        Raises:
            MapError: it cannot be written.
        """
        ...

    def close(self) -> None:
        """Releases files and threads."""
        ...


class IntoMap:
    """Maps a drive, through the robot's own view of the map, which grows.

    Args:
        owner: the robot.
        opened: its view of the map.
    """

    def __init__(self, owner: Owner, opened: Map) -> None:
        self._owner = owner
        self._opened = opened
        self._drive: SavedDrive | None = None
        with ExitStack() as stack:
            stack.enter_context(opened)
            stack.enter_context(opened.writing())
            self._words = node_words(opened, owner.settings, owner.options.relocaliser)
            self.localiser: Localiser = owner.localiser_in(opened, saves=True)
            self._stack = stack.pop_all()

    def begin(self, session: Session, made_by: tuple[DescriptorKind, str]) -> Keeper:
        """See `Into`."""
        opened, owner = self._opened, self._owner
        writer = opened.begin_session(
            session,
            owner.camera,
            descriptor=made_by[0],
            frontend=made_by[1],
            author=session.robot,
            message=f"map {session.robot}",
            configuration={**configuration_of(owner.settings, owner.options), "live": True},
        )
        self._drive = SavedDrive(
            opened, writer, self.localiser, owner.settings, self._words, waits=False
        )
        return self._drive.mapper

    def end(self, saving: Saving, *, well: bool) -> None:
        """See `Into`; commits what was written, even if a later write failed."""
        drive = self._ended(well=well)
        if drive is not None:
            saving.revision = drive.commit().number
            saving.state = SavingState.COMMITTED if well else saving.state

    def leave(self, *, well: bool) -> None:
        """See `Into`."""
        drive = self._ended(well=well)
        if drive is not None:
            drive.leave()

    def _ended(self, *, well: bool) -> SavedDrive | None:
        """The drive, once all that it saved is written; None if none has begun."""
        drive, self._drive = self._drive, None
        if drive is None:
            return None
        try:
            if well:
                drive.finish()
            drive.close()
        except MapError:
            if well:
                raise
        return drive

    def close(self) -> None:
        """See `Into`."""
        self._stack.close()


class IntoMemory:
    """Keeps only path and attempts of a drive; see `engram.robot.live`.

    Args:
        owner: the robot.
        opened: the map.
    """

    def __init__(self, owner: Owner, opened: Map) -> None:
        self.localiser = owner.localiser_in(opened, remembers=True)
        self._owner = owner
        self._map_path = Path(opened.location)
        self._spool: Spool | None = None
        self._saver: Saver | None = None
        self._memory: Memory | None = None

    def begin(self, session: Session, made_by: tuple[DescriptorKind, str]) -> Keeper:
        """See `Into`."""
        owner, mapper = self._owner, self._owner.settings.mapper
        configuration = configuration_of(owner.settings, owner.options)
        self._spool = Spool(
            self._map_path,
            session,
            owner.camera,
            made_by,
            configuration,
            mapper.memory_bytes,
        )
        self._saver = Saver(self._spool, checkpoint_every=mapper.checkpoint_every, waits=False)
        self._memory = Memory(self.localiser, self._saver, path_id(session.id))
        return self._memory

    def end(self, saving: Saving, *, well: bool) -> None:
        """See `Into`."""
        spool = self._ended(well=well)
        if spool is None:
            return
        try:
            committed = commit_spools(self._map_path)
        except MapLockedError:
            saving.state, saving.reason = SavingState.SPOOLED, str(spool.path)
            return
        if spool.path in committed:
            saving.revision = committed[spool.path].number
        saving.state = SavingState.COMMITTED if well else saving.state

    def leave(self, *, well: bool) -> None:
        """See `Into`; the memory of an unfit drive is dropped."""
        spool = self._ended(well=well)
        if spool is not None:
            spool.path.unlink(missing_ok=True)

    def _ended(self, *, well: bool) -> Spool | None:
        """The spool, once all is written; None if none has begun."""
        spool, self._spool = self._spool, None
        if self._saver is None or spool is None or self._memory is None:
            return None
        try:
            if well:
                self._memory.finish()
            self._saver.finish()
        except MapError:
            if well:
                raise
        finally:
            spool.close()
        return spool

    def close(self) -> None:
        """See `Into`."""


class LiveDrive:
    """A live drive: begun by its first frame, kept until an error or the doctor ends that.

    Nothing here forwards to the keeper: the robot asks the one that each method returns, and after
    a write error or an unfit drive that is one that keeps nothing.

    Args:
        owner: the robot.
        into: where the session goes.
        saving: whether anything is kept, and the outcome of earlier drives; None to begin.
    """

    def __init__(self, owner: Owner, into: Into, saving: Saving | None = None) -> None:
        self.saving = saving or Saving(SavingState.ON)
        self._owner = owner
        self._into = into

    def begin(self, first: Arrived) -> Keeper:
        """Begins the drive with this pair or logged frame; returns its keeper."""
        session, keeper = self._owner.session(first), KEEPS_NOTHING
        self.saving.session = session.id
        try:
            if self.saving.state is not SavingState.FAILED:
                keeper = self._into.begin(session, self._owner.made_by(first))
        except MapError as error:
            keeper = self.failed(error)
        if self.saving.state is SavingState.FAILED:
            # The map may hold this very drive: its nodes are then not the robot's own.
            session = replace(session, id=UNNAMED_LIVE_SESSION)
        self._into.localiser.begin(session)
        return keeper

    def failed(self, error: MapError) -> Keeper:
        """A write failed: ends the saving, not the drive; returns the keeper from now on."""
        self.saving.state, self.saving.reason = SavingState.FAILED, str(error)
        return KEEPS_NOTHING

    def examined(self, fatal: Sequence[Finding], keeper: Keeper) -> Keeper:
        """The keeper from now on: a drive that the doctor found unfit is not committed.

        Args:
            fatal: what it found.
            keeper: the keeper until now.
        """
        if not fatal or self._owner.options.force or self.saving.state is not SavingState.ON:
            return keeper
        try:
            self._leave(fatal)
        except MapError as error:
            return self.failed(error)
        return KEEPS_NOTHING

    def close(self, fatal: Sequence[Finding] = ()) -> None:
        """Ends the drive and commits it as a revision, unless the doctor found it unfit.

        Args:
            fatal: what it found.

        Raises:
            MapError: it cannot be written, though no earlier write failed.
        """
        failed = self.saving.state is SavingState.FAILED
        unfit = bool(fatal) and not self._owner.options.force
        try:
            if unfit and not failed:
                self._leave(fatal)
            elif unfit:
                self._into.leave(well=False)
            else:
                self._into.end(self.saving, well=not failed)
        except MapError as error:
            if not failed:
                self.failed(error)
                raise
        finally:
            self._into.close()

    def _leave(self, fatal: Sequence[Finding]) -> None:
        self._into.leave(well=True)
        self.saving.state, self.saving.reason = SavingState.UNCOMMITTED, _reasons(fatal)


def _reasons(fatal: Sequence[Finding]) -> str:
    return "; ".join(one.message for one in fatal)
