"""Saving during a live drive: map or memory grow beside the robot's loop without delaying it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from engram.doctor import Finding
from engram.errors import MapError, MapLockedError
from engram.frontend import DescriptorKind, Frame, Frontend, StereoPair
from engram.geometry import StereoCamera
from engram.graph.model import Clock, Session, SessionId, path_id
from engram.localiser import (
    KEEPS_NOTHING,
    Hint,
    Keeper,
    Localisation,
    Localiser,
    Relocaliser,
)
from engram.mapper import Memory, Saver
from engram.maps import Map, SessionState
from engram.odometry import Motion
from engram.robot.front import Arrived
from engram.robot.localisers import localiser_in
from engram.robot.saving import SavedDrive, begin_or_resume, configuration_of, node_words
from engram.robot.settings import RobotOptions, Settings
from engram.robot.spool import Spool, commit_spools
from engram.sequences import SequenceInfo, first_pair_hash, session_of

# Stamps from here (1973) on come from a clock; smaller ones count from the robot's start.
_CLOCK_FROM_NS = 10**17


class SavingState(StrEnum):
    """State of the saving of a live drive."""

    OFF = "off"
    ON = "on"
    FAILED = "failed"
    SPOOLED = "spooled"
    COMMITTED = "committed"
    SEALED = "sealed"


@dataclass(slots=True)
class Saving:
    """Whether and where a live drive is saved.

    Attributes:
        state: `FAILED` after a write error: the robot continues to localise, and what it had saved
            is kept; `SPOOLED` if another process writes to the map, so that the drive's memory
            waits in a file beside it; `SEALED` if the doctor found something fatal: nothing was
            committed, and a mapped session waits for ``engram check --seal``.
        reason: why saving failed or was not committed, or where the memory waits.
        session: the drive.
        revision: number of the revision that holds the drive.
        nodes: number of saved nodes.
    """

    state: SavingState = SavingState.OFF
    reason: str = ""
    session: SessionId | None = None
    revision: int | None = None
    nodes: int = 0

    def text(self) -> str:
        """For people."""
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
            case SavingState.SEALED:
                return (
                    f"not committed, because the drive is unfit: {self.reason}; engram check "
                    "--seal "
                    "commits what was mapped anyway"
                )
        return f"saving is {self.state}"


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
    """

    name: str | None
    camera: StereoCamera
    settings: Settings
    options: RobotOptions
    recorded: Session | None = None
    finder: str | Relocaliser | None = None

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
            policy=self.options.policy,
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
        return session_of(info, self.camera, pair.stamp_ns, pixels)


class Into(Protocol):
    """Where a live drive is kept."""

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

    def end(self, saving: Saving, *, well: bool, unfit: bool) -> None:
        """Commits the drive as a revision, unless it is unfit.

        Args:
            saving: is told what became of it.
            well: whether everything was written so far.
            unfit: whether the doctor found something fatal.
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
        if opened.session_state(session.id) is not SessionState.ABSENT:
            raise MapError(
                f"{opened.location} already holds session {session.id}; give its recording to "
                "engram map, which resumes an interrupted session"
            )
        about = {
            "author": session.robot,
            "message": f"map {session.robot}",
            "configuration": configuration_of(owner.settings, owner.options),
        }
        writer = begin_or_resume(opened, session, owner.camera, made_by, about)
        self._drive = SavedDrive(
            opened, writer, self.localiser, owner.settings, self._words, waits=False
        )
        return self._drive.mapper

    def end(self, saving: Saving, *, well: bool, unfit: bool) -> None:
        """See `Into`; commits what was written, even if a later write failed."""
        drive = self._drive
        if drive is None:
            return
        try:
            if well:
                drive.finish()
            drive.close()
        except MapError:
            if well:
                raise
        if unfit:
            return
        saving.revision = drive.commit().number
        saving.state = SavingState.COMMITTED if well else saving.state

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

    def end(self, saving: Saving, *, well: bool, unfit: bool) -> None:
        """See `Into`; the memory of an unfit drive is dropped."""
        if self._saver is None or self._spool is None or self._memory is None:
            return
        try:
            if well:
                self._memory.finish()
            self._saver.finish()
        except MapError:
            if well:
                raise
        finally:
            self._spool.close()
        if unfit:
            self._spool.path.unlink(missing_ok=True)
            return
        try:
            committed = commit_spools(self._map_path)
        except MapLockedError:
            saving.state, saving.reason = SavingState.SPOOLED, str(self._spool.path)
            return
        if committed:
            saving.revision = committed[-1].number
        saving.state = SavingState.COMMITTED if well else saving.state

    def close(self) -> None:
        """See `Into`."""


class LiveKeeper(Keeper):
    """Keeps a live drive by another keeper, and stops keeping after a write error.

    The session begins with the first frame, which identifies the drive.

    Args:
        owner: the robot.
        into: where the session goes.
    """

    def __init__(self, owner: Owner, into: Into) -> None:
        self.saving = Saving(SavingState.ON)
        self._owner = owner
        self._into = into
        self._keeper = KEEPS_NOTHING

    def begin(self, first: Arrived) -> None:
        """Begins the drive with this pair or logged frame."""
        session = self._owner.session(first)
        self._into.localiser.begin(session)
        self.saving.session = session.id
        try:
            self._keeper = self._into.begin(session, self._owner.made_by(first))
        except MapError as error:
            self._fail(error)

    def examined(self, fatal: Sequence[Finding]) -> None:
        """Stops keeping a drive that the doctor found unfit; `close` does not commit it."""
        if fatal and not self._owner.options.force and self.saving.state is SavingState.ON:
            self._keeper = KEEPS_NOTHING
            self.saving.state, self.saving.reason = SavingState.SEALED, _reasons(fatal)

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
            if self.saving.session is not None:
                self._into.end(self.saving, well=not failed, unfit=unfit)
                if unfit and not failed:
                    self.saving.state, self.saving.reason = SavingState.SEALED, _reasons(fatal)
        except MapError as error:
            if not failed:
                self._fail(error)
                raise
        finally:
            self._into.close()

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `Keeper`."""
        return self._keeper.hint(live, motion)

    def may_propose(self, *, certain: bool) -> bool:
        """See `Keeper`."""
        return self._keeper.may_propose(certain=certain)

    def may_propose_own(self, *, certain: bool) -> bool:
        """See `Keeper`."""
        return self._keeper.may_propose_own(certain=certain)

    def keep(self, live: Frame, found: Localisation) -> Localisation:
        """See `Keeper`; a write error ends the saving, not the drive."""
        try:
            found = self._keeper.keep(live, found)
        except MapError as error:
            self._fail(error)
            return found
        self.saving.nodes += found.saved is not None
        return found

    def withdrawn(self, found: Localisation) -> None:
        """See `Keeper`."""
        self._keeper.withdrawn(found)

    def _fail(self, error: MapError) -> None:
        self._keeper = KEEPS_NOTHING
        self.saving.state, self.saving.reason = SavingState.FAILED, str(error)


def _reasons(fatal: Sequence[Finding]) -> str:
    return "; ".join(one.message for one in fatal)
