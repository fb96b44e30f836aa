"""A map on disk: opening, reading, adding sessions, and history."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import insert

from engram.errors import InputError, RevisionError
from engram.files import map_path
from engram.geometry.cameras import StereoCamera
from engram.graph.clock import check_zone
from engram.graph.model import LONGEST_NAME, Amendable, Amendment, NodeId, Session, SessionId
from engram.keywords import keywords
from engram.maps.attempts import words_row, write_words
from engram.maps.frame_reader import DEFAULT_CACHE_BYTES
from engram.maps.hiding import Reverted, compare, hide_revision
from engram.maps.map_writer import MapWriter
from engram.maps.records import Revision, RevisionStatus
from engram.maps.revisions import collect_abandoned, commit_revision, new_revision
from engram.maps.rows import START, checked_text, sealed
from engram.maps.schema import revisions
from engram.maps.sqlite import SqliteDatabase
from engram.maps.tags import Tag, TagWriter
from engram.maps.view import View

if TYPE_CHECKING:
    from engram.robot.robot import Robot
    from engram.robot.settings import Settings


def checked_amendments(
    shown: Session, changes: Mapping[Amendable, str], now_ns: int
) -> dict[Amendable, Amendment]:
    """The amendments that change a session.

    Raises:
        InputError: none does, or a value is not valid.
        ConfigError: the zone is unknown.
    """
    found = {}
    for what, value in changes.items():
        checked_text(value, what)
        if what is Amendable.ZONE:
            check_zone(value)
        if (
            not value
            or (what is Amendable.ROBOT and len(value) > LONGEST_NAME)
            or (what is Amendable.START and not START.fullmatch(value))
        ):
            raise InputError(f"{value!r:.60} is not valid as the {what} of a session")
        amendment = Amendment(shown.id, what, value, now_ns)
        if amendment.applied(shown) != shown:
            found[what] = amendment
    if not found:
        raise InputError(f"session {shown.id} has these values already: nothing to amend")
    return found


_P = ParamSpec("_P")
_T = TypeVar("_T")


def _writes(method: Callable[Concatenate[Map, _P], _T]) -> Callable[Concatenate[Map, _P], _T]:
    """Locks the map for writing while the method runs."""

    @wraps(method)
    def locked(self: Map, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        with self.writing():
            return method(self, *args, **kwargs)

    return locked


class Map(MapWriter):
    """A map on disk as of one revision. A context manager; threads may share it.

    Readers and the writer never wait for each other: readers see the revisions committed when
    they opened the map. Records stay in memory once read. The graph and the paths are read once,
    and grow with what this process writes.

    Attributes:
        frames: the frames of its nodes: a `LandmarkSource`.
    """

    @staticmethod
    def create(location: Path | str) -> Map:
        """Creates an empty map and opens it for writing.

        Raises:
            InputError: the file exists already, or its folder does not.
            MapError: it cannot be written.
        """
        SqliteDatabase.create(map_path(location))
        return Map.open(location, writes=True)

    @staticmethod
    def open(
        location: Path | str,
        *,
        at: int | str | None = None,
        writes: bool = False,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
    ) -> Map:
        """Opens an existing map.

        Args:
            location: path of the map file.
            at: number or name of the revision to see (`resolve`); None for the newest, 0 for the
                map before the first.
            writes: lock it for writing until `close`.
            cache_bytes: largest memory of decoded frames.

        Raises:
            NotAMapError: the file does not exist or is not a map.
            FormatVersionError: a newer Engram wrote it.
            MapCorruptError: it is too damaged to read.
            MapLockedError: another process writes to it; names process and host.
            RevisionError: it has no such revision.
        """
        return Map(
            SqliteDatabase(map_path(location)), at=at, writes=writes, cache_bytes=cache_bytes
        )

    @keywords(policy="ranking", map="maps")
    def robot(
        self,
        camera: StereoCamera,
        settings: Settings | None = None,
        *,
        name: str | None = None,
        maps: bool = False,
        remembers: bool = False,
        ranking: str = "recall",
        lanes: int = 2,
        rounds: int = 2,
        relocaliser: str | None = "fabmap",
        threads: int | None = None,
    ) -> Robot:
        """A robot that localises in this map; see `Robot.step`.

        A robot that maps or remembers stores its drive as a session; closing the robot commits it
        as a revision. It sees its own nodes at once; maps opened after the commit show them.

        Args:
            camera: its rectified stereo camera; it may differ from those of the map.
            settings: the configuration; None for the defaults.
            name: name of the robot; required if its drives are stored.
            maps: whether it saves frames that it does not localise, on a separate thread with
                checkpoints. It is the map's only writer until it is closed. After a crash, the
                robot's next such drive first commits the saved part (`Saving.recovered`).
            remembers: whether to store its path and match attempts, by which later drives rank;
                implied by `maps`. They are kept in a file next to the map until the drive ends and
                no other process writes to the map.
            ranking: which nodes to try first: "recall", "path", "distance", …; key of
                `engram.ranking.POLICIES`.
            lanes: attempts in parallel (Np), >= 1.
            rounds: rounds of attempts per frame (Nr), >= 1; up to 32 when lost.
            relocaliser: how a lost robot is found: "fabmap", "signature" (net), "bag-of-words",
                "exhaustive"; None for none.
            threads: most threads of the robot, the caller's included; None: `lanes` + 2 to 4.

        Raises:
            ConfigError: a keyword or the ranking is unknown, a number is out of range, the name
                is missing or not valid, or the threads are too few.
            InputError: the camera is not a `StereoCamera`.
            MapLockedError: it maps, and another process writes to the map.
            RevisionError: it stores its drive, and the map is open at an older revision.
            MapError: the map is closed.
        """
        from engram.robot.drive_session import RobotSetup
        from engram.robot.settings import RobotOptions, Settings
        from engram.robot.starting import robot_in

        self._database.check_open()
        asked = RobotOptions(ranking, lanes, rounds, relocaliser=relocaliser, threads=threads)
        setup = RobotSetup(camera, settings or Settings(), asked, name)
        return robot_in(self, setup, maps=maps, remembers=remembers)

    @_writes
    def revert(
        self, named: int | str, *, author: str, message: str = "", dry_run: bool = False
    ) -> Reverted:
        """Reverts a revision, by a new one that hides its rows (`hide_revision`).

        Args:
            named: the revision.
            author: the person or robot.
            message: reason.
            dry_run: only report the result.

        Raises:
            RevisionError: there is no such revision, nothing of it is visible, or a session is
                being written.
            StorageFullError: no space; the map is unchanged.
        """
        self._check_none_open()
        number = self.resolve(named)
        if number == 0:
            raise RevisionError(f"{self._database.name}: there is no revision 0 to revert")
        said = f"revert revision {number}" + (f": {message}" if message else "")
        opened = new_revision(self._keys, self._holder, author, said, {"revert": number})
        try:
            with self._database.writing() as connection:
                connection.execute(insert(revisions), [sealed(revisions, opened)])
                own = View(self._view.at, opened["key"])
                hide_revision(connection, self._keys, own, number, opened["key"])
                done = compare(connection, number, self._view, own)
                if dry_run:
                    raise _DryRunError
                revision = commit_revision(connection, opened["key"], was=RevisionStatus.ABANDONED)
                done = replace(done, revision=revision)
        except _DryRunError:
            return done
        self.frames.forget()
        self.forget()
        self._keys.forget_nodes()
        self._see(View(self.resolve(None)))
        return done

    @_writes
    def put_words(self, vocabulary: bytes, found: Mapping[NodeId, NDArray[np.int32]]) -> None:
        """Stores words of nodes in one transaction; no revision, since they follow from other rows.

        Args:
            vocabulary: hash (16 bytes) of the vocabulary.
            found: the distinct words (n,) of each node, rising.

        Raises:
            InputError: a node is not in the map, or its words do not rise.
            StorageFullError: no space; the map is unchanged.
        """
        rows = []
        for node, shown in found.items():
            key = self._keys.find_node(node)
            if key is None:
                raise InputError(f"words: node {node} is not in the map")
            rows.append(words_row(key, vocabulary, shown))
        with self._database.writing() as connection:
            write_words(connection, rows)

    @_writes
    def put_vocabulary(
        self, body: bytes, *, author: str, message: str, configuration: Mapping[str, Any]
    ) -> Revision:
        """Stores a vocabulary in its own revision; the newest counts.

        Args:
            body: the vocabulary, encoded.
            author: the person or robot.
            message: text for `log`.
            configuration: how it was trained, plain JSON data.

        Raises:
            RevisionError: a session is being written.
            StorageFullError: no space; the map is unchanged.
        """
        with self.begin_revision(
            author=author, message=message, configuration=configuration
        ) as writer:
            writer.put_vocabulary(body)
            revision = writer.commit()
        self._derived.clear()
        return revision

    @_writes
    def amend(
        self,
        session: SessionId,
        changes: Mapping[Amendable, str],
        *,
        author: str,
        message: str = "",
    ) -> Revision:
        """Corrects facts of a session; its record and all ids stay unchanged.

        Args:
            session: the session.
            changes: new values by fact: a robot's name, an IANA zone, or the UTC time of the
                session's first pair, ns.
            author: the person or robot.
            message: reason.

        Raises:
            InputError: the map has no such session, it has these values already, or a value is not
                valid.
            ConfigError: the zone is unknown.
            RevisionError: a session is being written.
            StorageFullError: no space; the map is unchanged.
        """
        if session not in self.sessions:
            raise InputError(f"{self.location} has no session {session}")
        now = checked_amendments(self.sessions[session], changes, time.time_ns())
        with self.begin_revision(
            author=author,
            message=message or f"amend {', '.join(now)} of session {session}",
            configuration={"amend": {"session": str(session), **changes}},
        ) as writer:
            for amendment in now.values():
                writer.add_amendment(amendment)
            revision = writer.commit()
        self.forget()
        return revision

    @_writes
    def tag(
        self,
        name: str,
        named: int | str | None = None,
        *,
        author: str,
        message: str = "",
        move: bool = False,
    ) -> Tag:
        """Tags a revision. History and content hash do not change.

        Args:
            name: a letter, then letters, digits and ``. _ / + -``.
            named: the revision; None for the newest.
            author: the person or robot.
            message: reason.
            move: whether to move a tag that another revision has.

        Raises:
            InputError: the name is not valid.
            RevisionError: there is no such revision, or another one has the name.
        """
        with self._database.writing() as connection:
            tags = TagWriter(connection, self._keys, self.location)
            return tags.set(name, named, author, message, move=move)

    @_writes
    def untag(self, name: str, *, author: str) -> Tag:
        """Removes a tag and returns it.

        Raises:
            RevisionError: there is no such tag.
        """
        with self._database.writing() as connection:
            return TagWriter(connection, self._keys, self.location).remove(name, author)

    @_writes
    def clean(self) -> int:
        """Removes the rows of abandoned revisions; returns their number."""
        self._check_none_open()
        with self._database.writing() as connection:
            return collect_abandoned(connection)


class _DryRunError(Exception):
    """Ends a transaction without committing it."""


@keywords()
def open_map(path: Path | str, at: int | str | None = None, create: bool = False) -> Map:
    """Opens a map for localising, writing or reading.

    Until it is written to, the map stays as it is now, whatever others commit: open it again to see
    later revisions. A robot stays with the map that it began in.

    Args:
        path: NAME.engram.
        at: number or name of a revision (7, a tag, "head~2"), to see the map as it was then; None
            for the newest.
        create: create an empty map if the file does not exist and no revision is named.

    Raises:
        NotAMapError: the file does not exist, or is not a map.
        FormatVersionError: a newer Engram wrote it.
        MapCorruptError: it is too damaged to read.
        RevisionError: there is no such revision.
        InputError: a map is to be created, and its folder does not exist.
        ConfigError: a keyword is unknown.
    """
    if create and at is None and not map_path(path).exists():
        Map.create(path).close()
    return Map.open(path, at=at)
