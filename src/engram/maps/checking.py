"""Verifies every byte and every reference of a map."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, Table, select

from engram.errors import EngramError, MapCorruptError
from engram.frontend.blobs import (
    HASH_BYTES,
    blob_hash,
    content_digest,
    decode_landmarks,
    decode_thumbnail,
)
from engram.frontend.features import feature_kind
from engram.frontend.frame import DescriptorKind, FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.graph.model import EdgeKind, NodeId, PathEntryKind, SessionId
from engram.maps.attempts import decode_words, page_of, unpack
from engram.maps.columns import Columns
from engram.maps.content import verified_hash
from engram.maps.marks import goal_from_row, removal_from_row
from engram.maps.place_blocks import problem_of
from engram.maps.records import CheckReport, Problem
from engram.maps.revisions import sessions_of
from engram.maps.rows import (
    Row,
    amendment_from_row,
    camera_from_row,
    cell_at,
    cell_of,
    check_tally,
    describe,
    edge_arrays,
    edges_from_rows,
    from_json,
    session_from_row,
    transform_from_bytes,
    uuid_from_bytes,
    verified,
)
from engram.maps.runs import Keys, load_runs
from engram.maps.schema import (
    FORMAT_VERSION,
    VERSIONED,
    amendments,
    attempts,
    cameras,
    edges,
    forgotten,
    frames,
    frontends,
    goals,
    hidden,
    map_format,
    metadata,
    nodes,
    omissions,
    omitted_landmarks,
    path_entries,
    paths,
    place_blocks,
    placements,
    receipts,
    removals,
    revisions,
    runs,
    sessions,
    statistics,
    tag_tally,
    tags,
    vocabularies,
    words,
)
from engram.maps.sqlite import SqliteDatabase
from engram.maps.totals import count_all, own_rows, totals_at
from engram.maps.view import LARGEST_KEY, View, few, head

# The table that a column refers to.
_REFERENCES = {
    "session": sessions,
    "camera": cameras,
    "frontend": frontends,
    "node": nodes,
    "a": nodes,
    "b": nodes,
    "path": paths,
}
_ORDER = (
    map_format,
    revisions,
    cameras,
    frontends,
    *VERSIONED,
    receipts,
    tags,
    tag_tally,
    words,
    place_blocks,
    runs,
)
assert set(_ORDER) == set(metadata.sorted_tables)

_DERIVED = {words, place_blocks, runs}
_HIDEABLE = {*VERSIONED} - {hidden}
# Rows of the largest tables that are read at once, and of those with large bodies.
_MOST = 10_000
_AT_ONCE = {frames: 20, attempts: 40, vocabularies: 1, place_blocks: 1}
_NONE = np.zeros(0, np.int64)

# Rounding of rotations that come from chains of products.
_ROTATION_TOLERANCE = 1e-6
_NOBODY = NodeId(UUID(int=0))
_NO_SESSION = SessionId(UUID(int=0))


def check(database: SqliteDatabase, *, thin: bool = False, since: int | None = None) -> CheckReport:
    """Verifies the file's structure, every row, every blob and every reference.

    Rows are read in parts, and those that they refer to are looked up: memory does not grow with
    the map, but by 16 bytes a node.

    Args:
        database: of the map.
        thin: whether frames of nodes may be missing, as in a hand-in.
        since: only later revisions are verified: their rows and what
            they refer to, without the structure of the file; None for everything.
    """
    checking = _Checking(database, thin, since)
    if since is None:
        for fact in database.integrity_problems():
            checking.report(None, "", fact)
    for table in _ORDER:
        if since is None or table not in _DERIVED:
            checking.check_table(table)
    checking.check_whole()
    return checking.result()


@dataclass
class _Checking:
    """The state of a check."""

    database: SqliteDatabase
    thin: bool = False
    since: int | None = None
    problems: list[Problem] = field(default_factory=list)
    rows: int = 0
    blobs: int = 0
    revision_rows: dict[int, Row] = field(default_factory=dict)
    cameras: dict[int, StereoCamera] = field(default_factory=dict)
    kinds: dict[int, DescriptorKind] = field(default_factory=dict)
    # Sound rows to which those of the part that is being checked refer, by table and key.
    known: dict[Table, dict[int, Row]] = field(default_factory=lambda: defaultdict(dict))
    # Keys of sound rows, part by part.
    held: dict[Table, list[Keys]] = field(
        default_factory=lambda: {nodes: [], frames: [], map_format: []}
    )
    # Number of sound rows (of attempts, of those in them), first and last key, by revision.
    brought: Counter[tuple[int, str]] = field(default_factory=Counter)
    stored: Counter[int] = field(default_factory=Counter)
    # Whether rows are gone that were forgotten later: totals still count them.
    lacks_rows: bool = False
    ranges: dict[tuple[int, str], tuple[int, int]] = field(default_factory=dict)

    def report(self, table: Table | None, record: str, fact: str) -> None:
        self.problems.append(Problem("file" if table is None else table.name, record, fact))

    def check_table(self, table: Table) -> None:
        """Checks each row by itself, then its references."""
        try:
            for part in self._parts(table):
                self.rows += len(part)
                self.known.clear()
                if table not in _CHECKS_OF_COLUMNS or not self._are_sound(table, part):
                    self._check_rows(table, part)
        except MapCorruptError as error:
            self.report(table, "", str(error))

    def _parts(self, table: Table) -> Iterator[list[tuple[Any, ...]]]:
        """The rows of a table, so many at once."""
        most = _AT_ONCE.get(table, _MOST if table in _CHECKS_OF_COLUMNS else 100)
        with self.database.reading() as connection:
            for query in self._queries(table):
                ordered = query.order_by(*table.primary_key.columns)
                found = connection.execute(ordered.execution_options(yield_per=most))
                for part in found.partitions():
                    yield list(map(tuple, part))

    def _queries(self, table: Table) -> Iterator[Select[Any]]:
        """The rows that are to be checked."""
        if self.since is None or table not in {*VERSIONED, receipts}:
            yield select(table)
            return
        later = [
            row
            for row in self.revision_rows.values()
            if row["number"] is None or row["number"] > self.since
        ]
        if table is receipts:
            yield select(table).where(receipts.c.revision.in_([row["key"] for row in later]))
            return
        for row in later:
            with suppress(MapCorruptError):  # reported with the history
                yield select(table).where(own_rows(row).rows(table))

    def _are_sound(self, table: Table, part: list[tuple[Any, ...]]) -> bool:
        """Whether all these rows and their references are sound, without saying which is not."""
        try:
            found = Columns.verified(table, part)
            if not _CHECKS_OF_COLUMNS[table](found):
                return False
        except MapCorruptError:
            return False
        key, owners = found["key"], found["revision"].tolist()
        if not ((key >= 0) & (key <= LARGEST_KEY)).all() or {*owners} - self.revision_rows.keys():
            return False
        for column in _REFERENCES.keys() & found.values.keys():
            values = found[column].tolist()
            self.learn(_REFERENCES[column], values)
            for owner, value in {*zip(owners, values, strict=True)}:
                revision = self.revision_rows[owner]
                if self.reference_problem(revision, _REFERENCES[column], value):
                    return False
        for owner in {*owners}:
            own = key[found["revision"] == owner]
            self._count(table, owner, own, len(own))
        if table in self.held:
            self.held[table].append(key)
        return True

    def _check_rows(self, table: Table, part: list[tuple[Any, ...]]) -> None:
        names = [column.name for column in table.columns]
        for column in _REFERENCES.keys() & set(names):
            self.learn(_REFERENCES[column], [values[names.index(column)] for values in part])
        sound = []
        for values in part:
            try:
                (row,) = verified(table, [values])
            except MapCorruptError:
                self.report(table, self._name(table, values), "does not match its checksum")
                continue
            sound.append(values[0])
            self._check_row(table, row, self._name(table, values))
        if table in self.held:
            self.held[table].append(np.array(sound, np.int64))

    def _check_row(self, table: Table, row: Row, name: str) -> None:
        key = next(iter(row.values()))
        if not 0 <= key <= LARGEST_KEY:
            self.report(table, name, f"its key {key} leaves no room for others")
        if "revision" in row:
            amount = row["count"] if table is attempts else 1
            self._count(table, row["revision"], np.array([key]), amount)
            self._check_references(table, row, name)
        if table in _ROW_CHECKS:
            try:
                _ROW_CHECKS[table](self, row)
            except (EngramError, ValueError) as error:
                self.report(table, name, str(error))

    def _count(self, table: Table, revision: int, keys: Keys, amount: int) -> None:
        """Counts sound rows of a revision, whose keys come in ascending order."""
        self.brought[revision, table.name] += amount
        self.stored[revision] += len(keys)
        first, last = int(keys[0]), int(keys[-1])
        known = self.ranges.get((revision, table.name), (first, last))
        self.ranges[revision, table.name] = (min(known[0], first), max(known[1], last))

    def count_erased(self, table: Table, receipt: Row) -> None:
        """Counts a row that is no longer there among those of its revision."""
        key = np.array([receipt["target"]])
        self._count(table, receipt["revision"], key, receipt["count"])

    def is_erased(self, table: Table, key: int) -> bool:
        """Whether a receipt says that there was such a row."""
        of_table = (receipts.c.record == table.name) & (receipts.c.target == key)
        with self.database.reading() as connection:
            return connection.execute(select(receipts.c.key).where(of_table)).first() is not None

    def learn(self, table: Table, keys: Iterable[Any]) -> None:
        """Looks up rows, for as long as the same part is checked; unsound ones count as missing."""
        known = self.known[table]
        wanted = {key for key in keys if isinstance(key, int)} - known.keys()
        for part in few(sorted(wanted)):
            for values in self._rows_of(table, part):
                with suppress(MapCorruptError):
                    (row,) = verified(table, [values])
                    known[values[0]] = row

    def _rows_of(self, table: Table, keys: Sequence[int]) -> list[tuple[Any, ...]]:
        key = table.primary_key.columns[0]
        query = select(table).where(key.in_(keys)).order_by(key)
        try:
            with self.database.reading() as connection:
                return list(map(tuple, connection.execute(query)))
        except MapCorruptError:  # reported when the table is read
            alone = keys if len(keys) > 1 else []
            return [row for one in alone for row in self._rows_of(table, [one])]

    def _named(self, table: Table, key: int, otherwise: str) -> str:
        """The UUID of a row; other words if there is no sound one."""
        self.learn(table, [key])
        row = self.known[table].get(key)
        return otherwise if row is None else describe(table, list(row.values()))

    def _name(self, table: Table, values: Sequence[Any]) -> str:
        """Name of a row in messages, by UUID if possible."""
        row = dict(zip(table.columns.keys(), values, strict=False))
        if table in {frames, words}:
            return self._named(nodes, row["node"], f"of node row {row['node']}")
        if table is edges:
            ends = [self._named(nodes, row[end], f"row {row[end]}") for end in ("a", "b")]
            return f"{ends[0]} → {ends[1]} ({row['kind']})"
        if table is path_entries:
            return f"{self._named(paths, row['path'], str(row['path']))} #{row['sequence']}"
        if table is attempts:
            key = row["session"]
            return f"of session {self._named(sessions, key, f'row {key}')}"
        return describe(table, values)

    def _check_references(self, table: Table, row: Row, name: str) -> None:
        revision = self.revision_rows.get(row["revision"])
        if revision is None:
            self.report(table, name, f"its revision, row {row['revision']}, is missing")
            return
        for column, target in _REFERENCES.items():
            if column in row:
                fact = self.reference_problem(revision, target, row[column])
                if fact:
                    self.report(table, name, f"its {column} {fact}")

    def reference_problem(self, revision: Row, target: Table, key: int) -> str:
        """The fault of a reference from a row of `revision` to a row that was looked up, or ""."""
        row = self.known[target].get(key)
        if row is None:
            return f"(row {key} of {target.name}) is missing"
        if target in {cameras, frontends} or revision["status"] == "abandoned":
            return ""
        other = self.revision_rows.get(row["revision"])
        if other is None or other["key"] == revision["key"]:
            return ""
        later = (other["number"] or 0) > (revision["number"] or 0)  # lacking ones are reported
        if other["status"] != "committed" or (revision["status"] == "committed" and later):
            name = describe(target, list(row.values()))
            return f"({name} of {target.name}) is of a revision that is not before its own"
        return ""

    def check_whole(self) -> None:
        """Checks that involve several rows."""
        held, shown = (np.concatenate([_NONE, *self.held[one]]) for one in (nodes, frames))
        for part in () if self.thin else few(np.setdiff1d(held, shown).tolist()):
            self.known.clear()
            self.learn(nodes, part)  # at once: a damaged map may lack many
            for key in part:
                self.report(nodes, self._named(nodes, key, f"row {key}"), "its frame is missing")
        self._check_history()
        if sum(map(len, self.held[map_format])) != 1:
            self.report(map_format, "", "must have one row")
        self._check_tally()
        if not self.problems:
            self._check_sums()

    def _check_sums(self) -> None:
        """Works out again what a map stores of its rows: of all, or of those that are checked."""
        try:
            with self.database.reading() as connection:
                newest = head(connection)
                verified_hash(connection, newest, self.since or 0)
                if self.since is not None:
                    return
                if self.lacks_rows:
                    return
                totals, known = count_all(connection, View(newest))
                if not totals.agrees(totals_at(connection, newest)):
                    self.report(revisions, str(newest), "its totals are not those of the rows")
                if not known.agrees(load_runs(connection)):
                    self.report(runs, "", "are not those of the nodes and edges")
        except EngramError as error:
            self.report(revisions, "", str(error))

    def _check_tally(self) -> None:
        try:
            with self.database.reading() as connection:
                check_tally(connection)
        except EngramError as error:
            self.report(tag_tally, "", str(error))

    def _check_history(self) -> None:
        committed = [row for row in self.revision_rows.values() if row["status"] == "committed"]
        committed.sort(key=lambda row: row["number"] or 0)
        for number, row in enumerate(committed, start=1):
            if (row["number"], row["parent"] or 0) != (number, number - 1):
                self.report(
                    revisions,
                    str(row["number"]),
                    f"is number {number} of the history, with parent {row['parent']}",
                )
            if self.since is None or number > self.since:
                self._check_contents(row)

    def _check_contents(self, row: Row) -> None:
        """Compares the rows of a revision with what it says of them."""
        name = str(row["number"])
        try:
            contents = from_json(row["contents"], f"revision {name}")
            ranges = own_rows(row).ranges
        except MapCorruptError as error:
            self.report(revisions, name, str(error))
            return
        for table in (one for one in VERSIONED if not (self.thin and one is frames)):
            found = self.brought[row["key"], table.name]
            brought = contents.get(table.name, 0)
            if brought != found:
                self.report(
                    table, "", f"revision {name} added {brought} rows, but {found} are stored"
                )
            elif ranges.get(table.name) != self.ranges.get((row["key"], table.name)):
                self.report(
                    table, "", f"revision {name} has other rows than its ranges of keys say"
                )

    def result(self) -> CheckReport:
        rows = self.revision_rows.values()
        return CheckReport(
            problems=tuple(self.problems),
            rows=self.rows,
            blobs=self.blobs,
            interrupted=tuple(self._interrupted()),
            abandoned_rows=sum(
                self.stored[row["key"]] for row in rows if row["status"] == "abandoned"
            ),
        )

    def _interrupted(self) -> Iterator[SessionId]:
        """The sessions of open revisions without a writer."""
        writer = self.database.writer()
        live = "" if writer is None else writer.token
        for row in self.revision_rows.values():
            if row["status"] == "open" and row["writer"] != live:
                with suppress(EngramError), self.database.reading() as connection:
                    for session in sessions_of(connection, row["key"]):
                        yield SessionId(uuid_from_bytes(session["uuid"], "a session"))


def _check_format(_: _Checking, row: Row) -> None:
    if row["version"] != FORMAT_VERSION:
        raise MapCorruptError(f"says format {row['version']}, the file says {FORMAT_VERSION}")


def _check_revision(checking: _Checking, row: Row) -> None:
    checking.revision_rows[row["key"]] = row
    from_json(row["configuration"], "its configuration")
    if row["status"] not in {"open", "committed", "abandoned"}:
        raise MapCorruptError(f"has the status {row['status']!r}")
    if (row["status"] == "committed") != (row["number"] is not None):
        raise MapCorruptError(f"is {row['status']} and has the number {row['number']}")


def _check_camera(checking: _Checking, row: Row) -> None:
    checking.cameras[row["key"]] = camera_from_row(row)


def _check_frontend(checking: _Checking, row: Row) -> None:
    checking.kinds[row["key"]] = feature_kind(row["descriptor"]).name


def _check_session(checking: _Checking, row: Row) -> None:
    camera = checking.cameras.get(row["camera"])
    if camera is not None:
        session_from_row(row, camera.id)


def _check_node(_: _Checking, row: Row) -> None:
    uuid_from_bytes(row["uuid"], "the row")
    FrameStatus(row["status"])
    if not np.isfinite(row["driven_m"]):
        raise MapCorruptError(f"driven_m is {row['driven_m']}")


def _check_frame(checking: _Checking, row: Row) -> None:
    node = checking.known[nodes].get(row["node"], {})
    camera = checking.cameras.get(node.get("camera", -1))
    kind = checking.kinds.get(node.get("frontend", -1))
    if blob_hash(row["landmarks"]) != node.get("landmark_hash"):
        name = describe(nodes, list(node.values())) if node else "?"
        raise MapCorruptError(f"the landmarks are not those of node {name}")
    if camera is not None and kind is not None:
        checking.blobs += 1
        decode_landmarks(row["landmarks"], camera, kind)
    if row["thumbnail"] is not None:
        checking.blobs += 1
        decode_thumbnail(row["thumbnail"])


def _check_edge(_: _Checking, row: Row) -> None:
    (edge,) = edges_from_rows([row], [(_NOBODY, _NOBODY)])
    _check_rotation(edge.a_from_b.rotation)


def _check_path(_: _Checking, row: Row) -> None:
    uuid_from_bytes(row["uuid"], "the row")
    if row["partial"] not in {0, 1}:
        raise MapCorruptError(f"partial is {row['partial']}, not 0 or 1")


def _check_path_entry(_: _Checking, row: Row) -> None:
    PathEntryKind(row["kind"])
    if row["sequence"] < 0:
        raise MapCorruptError(f"has the sequence number {row['sequence']}")


def _check_omission(_: _Checking, row: Row) -> None:
    uuid_from_bytes(row["uuid"], "the row")
    _check_rotation(transform_from_bytes(row["node_from_omitted"], "the transform").rotation)


def _check_omitted_landmarks(_: _Checking, row: Row) -> None:
    uuid_from_bytes(row["uuid"], "the row")
    if len(row["landmark_hash"]) != HASH_BYTES:
        raise MapCorruptError(f"the hash has {len(row['landmark_hash'])} bytes, not {HASH_BYTES}")


def _check_attempts(checking: _Checking, row: Row) -> None:
    checking.blobs += 1
    _, table = unpack(row["body"], row["count"])
    if (page_of(table.node) != row["page"]).any():
        raise MapCorruptError(f"has attempts at nodes that are not of page {row['page']}")
    revision = checking.revision_rows.get(row["revision"])
    if revision is None:
        return  # reported already
    for name in ("reference", "node"):
        keys = np.unique(getattr(table, name)).tolist()
        checking.learn(nodes, keys)
        for key in keys:
            fact = checking.reference_problem(revision, nodes, key)
            if fact and not checking.is_erased(nodes, key):
                raise MapCorruptError(f"a {name} {fact}")


def _check_statistic(_: _Checking, row: Row) -> None:
    from_json(row["body"], f"statistic {row['name']}")


def _check_amendment(_: _Checking, row: Row) -> None:
    amendment_from_row(row, _NO_SESSION)


def _check_removal(_: _Checking, row: Row) -> None:
    removal = removal_from_row(row, {row["a"]: _NOBODY, row["b"]: _NOBODY})
    _check_rotation(removal.a_from_b.rotation)


def _check_placement(_: _Checking, row: Row) -> None:
    pose = transform_from_bytes(row["map_from_node"], "the transform")
    _check_rotation(pose.rotation)
    if row["cell"] != cell_of(pose):
        raise MapCorruptError(f"it is filed in cell {row['cell']}, but lies in {cell_of(pose)}")


def _check_goal(_: _Checking, row: Row) -> None:
    _check_rotation(goal_from_row(row, {row["node"]: _NOBODY}).node_from_goal.rotation)


def _check_vocabulary(checking: _Checking, row: Row) -> None:
    checking.blobs += 1
    if content_digest(row["body"]) != row["hash"]:
        raise MapCorruptError("the vocabulary does not match its hash")


def _check_hidden(checking: _Checking, row: Row) -> None:
    table = metadata.tables.get(row["record"])
    if table in _HIDEABLE:
        checking.learn(table, [row["target"]])
    if table not in _HIDEABLE or not (
        row["target"] in checking.known[table] or checking.is_erased(table, row["target"])
    ):
        raise MapCorruptError(f"hides row {row['target']} of {row['record']}, which is missing")


def _check_forgotten(_: _Checking, row: Row) -> None:
    uuid_from_bytes(row["uuid"], "the row")
    if row["record"] not in {sessions.name, nodes.name}:
        raise MapCorruptError(f"names a row of {row['record']!r:.40}")


def _check_receipt(checking: _Checking, row: Row) -> None:
    table = metadata.tables.get(row["record"])
    if table not in _HIDEABLE or row["count"] < 1 or len(row["digest"] or bytes(16)) != 16:
        raise MapCorruptError(f"row {row['target']} of {row['record']!r:.40} cannot have been")
    if row["uuid"] is not None:
        uuid_from_bytes(row["uuid"], "the row")
    checking.lacks_rows |= row["forgotten"] not in checking.revision_rows
    checking.count_erased(table, row)


def _check_tag(checking: _Checking, row: Row) -> None:
    numbers = {one["number"] for one in checking.revision_rows.values()} - {None}
    if row["number"] is not None and row["number"] not in numbers:
        raise MapCorruptError(f"tag {row['name']} names revision {row['number']}, which is missing")


def _check_words(checking: _Checking, row: Row) -> None:
    if row["node"] not in checking.known[nodes]:
        raise MapCorruptError("the node is missing")
    checking.blobs += 1
    decode_words(row["body"])


def _check_place_block(checking: _Checking, row: Row) -> None:
    checking.blobs += 1
    if len(row["vocabulary"]) != 16 or row["block"] < 0:
        raise MapCorruptError(f"block {row['block']} of a vocabulary that cannot be")
    if problem := problem_of(row["part"], row["content"]):
        raise MapCorruptError(problem)


def _check_rotation(rotation: np.ndarray[Any, np.dtype[np.float64]]) -> None:
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers that no rotation has
        skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not skew <= _ROTATION_TOLERANCE:
        raise MapCorruptError(f"its rotation is off by {skew:.2g}")


def _are_nodes(found: Columns) -> bool:
    _, statuses = found.texts["status"]
    return {*statuses} <= {*map(str, FrameStatus)} and bool(np.isfinite(found["driven_m"]).all())


def _are_edges(found: Columns) -> bool:
    _, kinds = found.texts["kind"]
    transforms, _ = edge_arrays(found["a_from_b"], found["covariance"], found["key"])
    return {*kinds} <= {*map(str, EdgeKind)} and _are_rotations(transforms)


def _are_path_entries(found: Columns) -> bool:
    _, kinds = found.texts["kind"]
    return {*kinds} <= {*map(str, PathEntryKind)} and bool((found["sequence"] >= 0).all())


def _are_placements(found: Columns) -> bool:
    transforms = found["map_from_node"].view("<f8")
    if not _are_rotations(transforms):
        return False
    places = zip(transforms[:, 9].tolist(), transforms[:, 10].tolist(), strict=True)
    cells = [cell_at(*place) for place in places]
    return bool(np.array_equal(found["cell"], cells))


def _are_rotations(transforms: NDArray[np.float64]) -> bool:
    """Whether (N, 12) numbers are finite, and the first nine of each are a rotation."""
    rotations = transforms[:, :9].reshape(-1, 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        skew = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    return bool(np.isfinite(transforms).all() and skew <= _ROTATION_TOLERANCE)


# Of the largest tables many rows are checked at once; one after the other where these find a fault.
_CHECKS_OF_COLUMNS: dict[Table, Callable[[Columns], bool]] = {
    nodes: _are_nodes,
    edges: _are_edges,
    path_entries: _are_path_entries,
    placements: _are_placements,
}
_ROW_CHECKS: dict[Table, Callable[[_Checking, Row], None]] = {
    map_format: _check_format,
    revisions: _check_revision,
    cameras: _check_camera,
    frontends: _check_frontend,
    sessions: _check_session,
    nodes: _check_node,
    frames: _check_frame,
    edges: _check_edge,
    paths: _check_path,
    path_entries: _check_path_entry,
    omissions: _check_omission,
    omitted_landmarks: _check_omitted_landmarks,
    attempts: _check_attempts,
    statistics: _check_statistic,
    vocabularies: _check_vocabulary,
    amendments: _check_amendment,
    removals: _check_removal,
    placements: _check_placement,
    goals: _check_goal,
    forgotten: _check_forgotten,
    hidden: _check_hidden,
    receipts: _check_receipt,
    tags: _check_tag,
    words: _check_words,
    place_blocks: _check_place_block,
}
