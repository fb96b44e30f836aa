"""Saving during a live drive: map or memory grow in parallel, without delaying the robot."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Protocol

from engram.doctor import Finding
from engram.errors import MapError, MapLockedError
from engram.frontend import DescriptorKind, Frontend, StereoPair
from engram.geometry import StereoCamera
from engram.graph.model import Clock, Session, SessionId, path_id
from engram.localiser import (
    KEEPS_NOTHING,
    UNNAMED_LIVE_SESSION,
    Keeper,
    Localiser,
    Relocaliser,
)
from engram.mapper import Memory, Saver
from engram.maps import Map
from engram.robot.front import Arrived
from engram.robot.localisers import localiser_in
from engram.robot.saved import Saving, SavingState
from engram.robot.saving import SavedDrive, configuration_of, node_words
from engram.robot.settings import RobotOptions, Settings
from engram.robot.spool import Spool, commit_spools
from engram.sequences import SequenceInfo, first_pair_hash, session_of

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
    """Keeps only path and attempts of a drive; see `engram.robot.spool`.

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
