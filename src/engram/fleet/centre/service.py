"""A centre: its folder, its database, its objects, its open maps; limits, times and states."""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta
from sqlalchemy import URL, Connection, Select, func, select, update

from engram.config import check_bounds, from_dict, to_dict
from engram.errors import InputError, MapLockedError
from engram.files import WriterLock
from engram.fleet.centre.copies import Copies, Publication, published_key
from engram.fleet.centre.database import AdvisoryLock, AuditCheck, ServiceDatabase, note
from engram.fleet.centre.objects import BucketObjects, FolderObjects, Objects, Packs
from engram.fleet.centre.problems import UnknownError
from engram.fleet.centre.tables import (
    JobState,
    MapListed,
    Published,
    artifacts,
    handins,
    maps,
    published,
    refs,
)
from engram.fleet.merge.merge_settings import MergeOptions
from engram.maps.map import Map
from engram.maps.records import Revision


@dataclass(slots=True)
class _Held:
    store: Map
    inode: int
    published: Published | None
    users: int = 0
    retired: bool = False


class OpenMaps:
    """Open maps, for reading, shared by threads.

    What is read of a map once (its log, its nodes) stays until it has a new revision.
    """

    def __init__(self) -> None:
        self._held: dict[Path, _Held] = {}
        self._lock = threading.Lock()

    @contextmanager
    def reading(self, path: Path, published: Published | None = None) -> Iterator[Map]:
        """The map as of its newest revision, which stays as it is within the block.

        Args:
            path: its file.
            published: what of it is published, if it is a copy: no later revision counts.

        Raises:
            MapError: it cannot be read.
        """
        with self._lock:
            held = self._newest(path, published)
            held.users += 1
        try:
            yield held.store
        finally:
            with self._lock:
                held.users -= 1
                _close_unused(held)

    def close(self) -> None:
        """Closes all maps that have no readers, and the others once their readers finish."""
        with self._lock:
            for held in self._held.values():
                held.retired = True
                _close_unused(held)
            self._held.clear()

    def _newest(self, path: Path, published: Published | None) -> _Held:
        held, inode = self._held.get(path), _inode(path)
        if held is not None:
            if (held.inode, held.published) == (inode, published) and _is_newest(held):
                return held
            del self._held[path]
            held.retired = True
            _close_unused(held)
        at = None if published is None else published.revision
        held = self._held[path] = _Held(Map.open(path, at=at), inode, published)
        return held


def _is_newest(held: _Held) -> bool:
    return held.published is not None or held.store.resolve(None) == held.store.revision


def log_of(store: Map) -> tuple[Revision, ...]:
    """Its revisions, oldest first, read once."""
    return store.derived(_log)


def _log(store: Map) -> tuple[Revision, ...]:
    return tuple(store.log())


def _inode(path: Path) -> int:
    """Inode of a path, by which a restored backup is noticed; 0 if the file is missing."""
    return path.stat().st_ino if path.exists() else 0


def _close_unused(held: _Held) -> None:
    if held.retired and not held.users:
        held.store.close()


DAY_NS = 86_400_000_000_000
_GIB = 2**30


@dataclass(frozen=True, slots=True)
class CentreSettings:
    """Limits and deadlines of a centre."""

    token_s: Annotated[int, Meta(ge=10, description="life of a robot's token, s")] = 900
    nonce_s: Annotated[
        int, Meta(ge=1, description="time to sign the nonce of a token request, s")
    ] = 60
    code_days: Annotated[int, Meta(ge=1, description="life of an enrolment code, days")] = 7
    bytes_a_day: Annotated[int, Meta(ge=0, description="upload limit of a robot, bytes a day")] = (
        20 * _GIB
    )
    handin_bytes: Annotated[int, Meta(ge=0, description="size limit of one hand-in, bytes")] = (
        8 * _GIB
    )
    open_handins: Annotated[
        int, Meta(ge=1, description="incomplete hand-ins of a robot at once")
    ] = 8
    handin_days: Annotated[int, Meta(ge=1, description="life of an incomplete hand-in, days")] = 14
    kept_days: Annotated[
        int,
        Meta(ge=0, description="life of unused parts, days"),
    ] = 14
    artifact_days: Annotated[int, Meta(ge=1, description="life of an unused download, days")] = 30
    sweep_h: Annotated[float, Meta(gt=0, description="time between sweeps, h")] = 24.0
    merge_tries: Annotated[
        int, Meta(ge=1, description="times that a worker may die while merging one hand-in")
    ] = 3
    admission_bytes: Annotated[int, Meta(ge=2**28, description="memory of admission, bytes")] = (
        4 * _GIB
    )
    admission_s: Annotated[int, Meta(ge=1, description="processor time of admission, s")] = 600
    poll_s: Annotated[float, Meta(gt=0, description="a worker looks for work this often, s")] = 0.25

    def __post_init__(self) -> None:
        check_bounds(self)


_UNDER_WAY = (JobState.OPEN, JobState.COMPLETE, JobState.REFUSED)


def manifest_key(name: str, manifest: str) -> str:
    """Where a manifest is kept among the objects."""
    return f"manifests/{name}/{manifest}"


def needed_manifests(connection: Connection, name: str, limit_ns: int) -> dict[str, str]:
    """Manifests of one map whose parts must stay: where each is kept among the objects, by its id.

    Those of hand-ins that are under way, refused, or ended since a time, and of what these
    continue; of each robot's newest merged one, which its next one continues; of downloads; and of
    what is published.
    """
    of_map = handins.c.map == name
    newest = newest_merged(name)
    late = handins.c.state.in_(_UNDER_WAY) | (handins.c.ended_ns >= limit_ns)
    ready = (artifacts.c.map == name) & (artifacts.c.state == JobState.READY)
    found: list[str] = []
    for query in (
        select(handins.c.manifest).where(of_map, late),
        select(handins.c.base).where(of_map, late, handins.c.base.is_not(None)),
        select(handins.c.manifest).where(of_map, handins.c.place.in_(newest)),
        select(artifacts.c.manifest).where(ready),
    ):
        found += connection.execute(query).scalars()
    keys = {manifest: manifest_key(name, manifest) for manifest in found}
    query = select(published.c.manifest).where(published.c.map == name)
    return keys | {one: published_key(name, one) for one in connection.execute(query).scalars()}


def newest_merged(name: str) -> Select[Any]:
    """Places of each robot's newest merged hand-in to a map."""
    merged = (handins.c.map == name) & (handins.c.state == JobState.MERGED)
    return select(func.max(handins.c.place)).where(merged).group_by(handins.c.robot)


_HOUR_NS = DAY_NS // 24
_SHOWN_CHARACTERS = 300
_NAME = re.compile(r"[a-z][a-z0-9-]{0,39}")


@dataclass(frozen=True, slots=True)
class MapPolicy:
    """How a map takes hand-ins.

    Attributes:
        merge: policy and budget of merging.
        gate: held-out drives that must not localise worse after a merge; paths of the centre.
        moves: ref that follows every merge that passed the gate; None for none.
        quiet: hours of the day in which it dreams by itself, from and to, UTC; None for never.
        copies: whether each worker keeps a copy in a folder of its own; see `engram.fleet.centre.
            copies`.
        cap_bytes: what its nodes may take after a sweep; None for any size.
    """

    merge: MergeOptions = field(default_factory=MergeOptions)
    gate: tuple[str, ...] = ()
    moves: str | None = None
    quiet: tuple[float, float] | None = None
    copies: bool = False
    cap_bytes: int | None = None

    def is_quiet(self, now_ns: int) -> bool:
        """Whether a time is within its quiet hours; equal ends are the whole day."""
        if self.quiet is None:
            return False
        begin_h, end_h = self.quiet
        length_h = (end_h - begin_h) % 24.0 or 24.0
        return (now_ns / _HOUR_NS - begin_h) % 24.0 < length_h


class Centre:
    """What every part of the service works on. A context manager.

    Args:
        folder: the centre's; created if missing.
        database: address of the database; None for SQLite in the folder.
        objects: address of the bucket; None for a folder in the folder.
        settings: limits and times.
        clock: the time, UTC, ns.

    Raises:
        InputError: the folder cannot be made or written to.
    """

    def __init__(
        self,
        folder: Path,
        database: str | None = None,
        objects: str | None = None,
        settings: CentreSettings | None = None,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self.folder = folder.resolve()  # as maps name it in what their errors say
        try:
            for name in ("maps", "objects", "work"):
                (folder / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder} cannot hold a centre: {error.strerror}") from error
        self.settings = settings or CentreSettings()
        self.now_ns = clock
        self.addresses = (database, objects)
        here = URL.create("sqlite", database=str(self.folder / "centre.sqlite"))
        self.database = ServiceDatabase(database or here)
        self.objects: Objects = (
            FolderObjects(self.folder / "objects") if objects is None else BucketObjects(objects)
        )
        self.copies = Copies(self)
        self.audit = AuditCheck()
        self._packs: dict[str, Packs] = {}
        self._open_maps = OpenMaps()

    def __enter__(self) -> Centre:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the database and the maps."""
        self._open_maps.close()
        self.database.close()

    def words_of(self, error: Exception) -> str:
        """The message of an error, for robots and people: without paths of the centre's machine."""
        return str(error).replace(f"{self.folder}{os.sep}", "")

    def fault_of(self, error: Exception) -> str:
        """Kind and first words of an unexpected error."""
        return f"{type(error).__name__}: {self.words_of(error)}"[:_SHOWN_CHARACTERS]

    def packs(self, name: str) -> Packs:
        """The parts of a map."""
        if name not in self._packs:
            self._packs[name] = Packs(self.database, self.objects, name)
        return self._packs[name]

    def add_map(self, name: str, by: str, policy: MapPolicy | None = None) -> None:
        """Makes an empty map; one that is there stays.

        Raises:
            InputError: the name cannot be one, or the file of a map is gone.
        """
        if not _NAME.fullmatch(name):
            raise InputError(
                f"{name!r:.60} cannot name a map: use a letter, then letters, digits and -, at "
                "most 40 characters"
            )
        path = self.folder / "maps" / f"{name}.engram"
        if self._has_copies(name):
            if not path.exists():
                self.copies.bring(name)
            return
        if not path.exists():
            if name in self.map_names():
                raise InputError(
                    f"{path} is missing, but merges into it are on record; restore it from a "
                    "backup, and robots upload the rest again"
                )
            Map.create(path).close()
        row = MapListed(name, self.now_ns(), 0, to_dict(policy or MapPolicy()))
        with self.database.writing() as connection:
            if self.database.add(connection, row):
                note(connection, self.now_ns(), by, "map", name)
            self._follow_file(connection, name, by)
        if self.database.rows(Published, limit=1):  # as of the maps that there are
            self.keep_copies(name, by)

    def _follow_file(self, connection: Connection, name: str, by: str) -> None:
        """Makes the tables of a map say what its file holds, if an older one was restored.

        Hand-ins merged into later revisions are open again, so that their robots send them again.
        """
        with Map.open(self.folder / "maps" / f"{name}.engram") as store:
            head, now = store.revision, self.now_ns()
        late = (handins.c.map == name) & (handins.c.revision > head)
        lost: dict[str, Any] = dict.fromkeys(("base", "place", "ended_ns", "revision", "report"))
        lost |= {"state": JobState.OPEN, "begun_ns": now, "tries": 0}
        again = update(handins).where(late).values(**lost)
        ahead = (refs.c.map == name) & (refs.c.revision > head)
        back = update(refs).where(ahead).values(revision=head, version=refs.c.version + 1)
        kept = (maps.c.name == name) & (maps.c.durable_revision > head)
        durable = update(maps).where(kept).values(durable_revision=head)
        changed = [connection.execute(change).rowcount for change in (again, back, durable)]
        if any(changed):
            note(connection, now, by, "older-file", name, revision=head, handins=changed[0])

    def keep_copies(self, name: str, by: str) -> None:
        """Lets workers keep copies of a map, and publishes what the file in this folder holds.

        Again it publishes what was committed or erased by hand since, while no worker ran here.

        Raises:
            InputError: tables or parts are in this folder, or the file does not continue what is
                published.
            MapLockedError: a worker has the map.
            StorageFullError, StoreError, MapError: it cannot be published now.
        """
        if None in self.addresses:
            raise InputError(
                "workers bring copies up to date from tables and parts that all of them reach: set "
                "ENGRAM_DATABASE and ENGRAM_OBJECTS"
            )
        with self._alone_with(name):
            row = self.map_row(name)
            if _is_copied(row) and not self.copies.continues(name):
                return
            found = self.copies.prepare(name, whole=True)
            policy = replace(from_dict(row.options, MapPolicy), copies=True)
            with self.database.writing() as connection:
                self.database.put(connection, replace(row, options=to_dict(policy)))
                self.copies.publish(connection, found)
                note(connection, self.now_ns(), by, "copies", name)

    @contextmanager
    def _alone_with(self, name: str) -> Iterator[None]:
        """Has both lanes of a map: that of this folder, and that of the database."""
        lanes: list[WriterLock | AdvisoryLock]
        lanes = [WriterLock(self.folder / "maps" / f"{name}.lane")]
        try:
            lanes.append(self.database.lane(name))
            yield
        finally:
            for lane in lanes:
                lane.release()

    def _has_copies(self, name: str) -> bool:
        row = self.database.row(MapListed, maps.c.name == name)
        return row is not None and _is_copied(row)

    def map_names(self) -> list[str]:
        """All maps."""
        return [row.name for row in self.database.rows(MapListed, order=maps.c.name)]

    @contextmanager
    def lane(self, name: str) -> Iterator[bool]:
        """Whether this worker has a map, or its downloads, to itself; its death frees them.

        The copy of a map is then what is published, and no other worker can publish.

        Raises:
            StorageFullError, StoreError, MapError: the copy cannot be brought up to date now.
        """
        of_map, _, of_downloads = name.partition(".")
        has_copies = self._has_copies(of_map)
        try:
            if has_copies:
                lock = self.database.lane(name)
            else:
                lock = WriterLock(self.folder / "maps" / f"{name}.lane")
        except MapLockedError:
            yield False
            return
        try:
            if has_copies and not of_downloads:
                self.copies.renew(of_map)
            yield True
        finally:
            lock.release()

    @contextmanager
    def changing(self, name: str) -> Iterator[Map]:
        """A map, locked to be changed by a person; see `prepared`.

        Raises:
            UnknownError: there is no such map.
            MapLockedError: a worker has it.
        """
        path = self.map_path(name)
        with self.lane(name) if self._has_copies(name) else nullcontext(True) as is_ours:
            if not is_ours:
                raise MapLockedError(f"a worker merges into {name}; wait until it is done")
            with Map.open(path) as store, store.writing():
                yield store

    def prepared(self, name: str) -> Publication | None:
        """What was committed to a copy of a map, to be published with `Copies.publish`.

        None if that is nothing, or workers share the file: then it counts already.

        Raises:
            StorageFullError, StoreError, MapError: it cannot be stored now.
        """
        return self.copies.prepare(name) if self._has_copies(name) else None

    def map_row(self, name: str) -> MapListed:
        """The row of a map.

        Raises:
            UnknownError: there is no such map.
        """
        row = self.database.row(MapListed, maps.c.name == name) if _NAME.fullmatch(name) else None
        if row is None:
            raise UnknownError(f"there is no map {name!r:.60}")
        return row

    def map_path(self, name: str) -> Path:
        """The file of a map, which holds what is published if it is a copy.

        Raises:
            UnknownError: there is no such map.
            StoreError, MapError: a copy cannot be brought up to date now.
        """
        self._brought(name)
        return self.folder / "maps" / f"{name}.engram"

    def reading(self, name: str) -> AbstractContextManager[Map]:
        """A map as of its newest revision, which stays open for the next one who asks.

        Raises:
            UnknownError: there is no such map.
            StoreError, MapError: a copy cannot be brought up to date now.
        """
        published = self._brought(name)
        return self._open_maps.reading(self.folder / "maps" / f"{name}.engram", published)

    def _brought(self, name: str) -> Published | None:
        """What is published of a map, once the copy here has it; None if there are no copies."""
        return self.copies.bring(name) if _is_copied(self.map_row(name)) else None

    def policy(self, name: str) -> MapPolicy:
        """How a map takes hand-ins."""
        return from_dict(self.map_row(name).options, MapPolicy)

    def set_policy(self, name: str, policy: MapPolicy, by: str) -> None:
        """Changes how a map takes hand-ins."""
        row = replace(self.map_row(name), options=to_dict(policy))
        with self.database.writing() as connection:
            self.database.put(connection, row)
            note(connection, self.now_ns(), by, "policy", name, policy=to_dict(policy))

    def set_durable(self, name: str, revision: int, by: str) -> None:
        """Notes that a backup holds a map up to a revision: robots may forget what it holds.

        Raises:
            InputError: the map has no such revision.
        """
        with self.reading(name) as store:
            if not 0 <= revision <= store.revision:
                raise InputError(f"{name} has revisions 0 to {store.revision}, not {revision}")
        row = replace(self.map_row(name), durable_revision=revision)
        with self.database.writing() as connection:
            self.database.put(connection, row)
            note(connection, self.now_ns(), by, "durable", name, revision=revision)


def _is_copied(row: MapListed) -> bool:
    return bool(row.options.get("copies"))


def kept_since_ns(centre: Centre) -> int:
    """What ended since then stays as it is."""
    return centre.now_ns() - centre.settings.kept_days * DAY_NS
