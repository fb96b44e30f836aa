"""Verifies every byte and every reference of a map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import Table, select

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
from engram.graph.model import NodeId, PathEntryKind, SessionId
from engram.maps.attempts import decode_words, page_of, unpack
from engram.maps.content import verified_hash
from engram.maps.marks import goal_from_row, removal_from_row
from engram.maps.place_blocks import problem_of
from engram.maps.records import CheckReport, Problem
from engram.maps.rows import (
    Row,
    amendment_from_row,
    camera_from_row,
    check_tally,
    describe,
    edges_from_rows,
    from_json,
    session_from_row,
    transform_from_bytes,
    uuid_from_bytes,
    verified,
)
from engram.maps.runs import load_runs
from engram.maps.schema import (
    FORMAT_VERSION,
    VERSIONED,
    amendments,
    attempts,
    cameras,
    edges,
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
from engram.maps.view import LARGEST_KEY, View, head

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
    tags,
    tag_tally,
    words,
    place_blocks,
    runs,
)
assert set(_ORDER) == set(metadata.sorted_tables)

# Rounding of rotations that come from chains of products.
_ROTATION_TOLERANCE = 1e-6
_NOBODY = NodeId(UUID(int=0))
_NO_SESSION = SessionId(UUID(int=0))


def check(database: SqliteDatabase, *, thin: bool = False) -> CheckReport:
    """Verifies the file's structure, every row, every blob and every reference.

    Args:
        database: of the map.
        thin: whether frames of nodes may be missing, as in a hand-in.
    """
    checking = _Checking(database, thin)
    for fact in database.integrity_problems():
        checking.report(None, "", fact)
    for table in _ORDER:
        checking.check_table(table)
    checking.check_whole()
    return checking.result()


@dataclass
class _Checking:
    """The state of a check."""

    database: SqliteDatabase
    thin: bool = False
    problems: list[Problem] = field(default_factory=list)
    rows: int = 0
    blobs: int = 0
    # The revision of each sound row, by table and key.
    revision_of: dict[Table, dict[int, int]] = field(default_factory=dict)
    revision_rows: dict[int, Row] = field(default_factory=dict)
    cameras: dict[int, StereoCamera] = field(default_factory=dict)
    kinds: dict[int, DescriptorKind] = field(default_factory=dict)
    # The hash of landmarks and the keys of camera and front-end of each node.
    landmark_hashes: dict[int, tuple[bytes, int, int]] = field(default_factory=dict)
    uuids: dict[tuple[Table, int], str] = field(default_factory=dict)
    brought: Counter[tuple[int, str]] = field(default_factory=Counter)
    # First and last key of the rows of each revision, by table.
    ranges: dict[tuple[int, str], tuple[int, int]] = field(default_factory=dict)
    session_ids: dict[int, SessionId] = field(default_factory=dict)
    # Sessions that an open revision shows again, with that revision.
    shown_again: dict[int, int] = field(default_factory=dict)

    def report(self, table: Table | None, record: str, fact: str) -> None:
        self.problems.append(Problem("file" if table is None else table.name, record, fact))

    def check_table(self, table: Table) -> None:
        """Checks each row by itself, then its references."""
        self.revision_of[table] = {}
        check_row = _ROW_CHECKS.get(table)
        for row in self._sound_rows(table):
            name = self._name(table, list(row.values()))
            key = next(iter(row.values()))
            self.revision_of[table][key] = row.get("revision", 0)
            if not 0 <= key <= LARGEST_KEY:
                self.report(table, name, f"its key {key} leaves no room for others")
            if "uuid" in row:
                self.uuids[table, key] = name
            if "revision" in row:
                self._count(table, row)
                self._check_references(table, row, name)
            if check_row is not None:
                try:
                    check_row(self, row)
                except (EngramError, ValueError) as error:
                    self.report(table, name, str(error))

    def _sound_rows(self, table: Table) -> Iterator[Row]:
        """Rows that match their checksums; the others are reported."""
        query = select(table).order_by(*table.primary_key.columns)
        try:
            with self.database.reading() as connection:
                for values in connection.execute(query.execution_options(yield_per=100)):
                    self.rows += 1
                    try:
                        yield from verified(table, [values])
                    except MapCorruptError:
                        self.report(table, self._name(table, values), "does not match its checksum")
        except MapCorruptError as error:
            self.report(table, "", str(error))

    def _name(self, table: Table, values: Sequence[Any]) -> str:
        """Name of a row in messages, by UUID if possible."""
        row = dict(zip(table.columns.keys(), values, strict=False))
        if table in {frames, words}:
            return self.uuids.get((nodes, row["node"]), f"of node row {row['node']}")
        if table is edges:
            ends = [self.uuids.get((nodes, row[end]), f"row {row[end]}") for end in ("a", "b")]
            return f"{ends[0]} → {ends[1]} ({row['kind']})"
        if table is path_entries:
            return f"{self.uuids.get((paths, row['path']), row['path'])} #{row['sequence']}"
        if table is attempts:
            session = self.uuids.get((sessions, row["session"]), f"row {row['session']}")
            return f"of session {session}"
        return describe(table, values)

    def _count(self, table: Table, row: Row) -> None:
        amount = row["count"] if table is attempts else 1
        named = row["revision"], table.name
        self.brought[named] += amount
        key = next(iter(row.values()))  # they come in this order
        self.ranges[named] = self.ranges.get(named, (key, key))[0], key

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
        """The fault of a reference from a row of `revision`; "" if it is valid."""
        known = self.revision_of[target]
        name = self.uuids.get((target, key), f"row {key}")
        if key not in known:
            return f"({name} of {target.name}) is missing"
        if target in {cameras, frontends} or revision["status"] == "abandoned":
            return ""
        other = self.revision_rows.get(known[key])
        if other is None or other["key"] == revision["key"]:
            return ""
        if other["status"] != "committed" or (
            revision["status"] == "committed" and other["number"] > revision["number"]
        ):
            return f"({name} of {target.name}) is of a revision that is not before its own"
        return ""

    def check_whole(self) -> None:
        """Checks that involve several rows."""
        lacking = self.revision_of[nodes].keys() - self.revision_of[frames].keys()
        for key in () if self.thin else lacking:
            self.report(nodes, self.uuids[nodes, key], "its frame is missing")
        self._check_history()
        if len(self.revision_of[map_format]) != 1:
            self.report(map_format, "", "must have one row")
        self._check_tally()
        if not self.problems:
            self._check_sums()

    def _check_sums(self) -> None:
        """Works out again what a map stores of all its rows."""
        try:
            with self.database.reading() as connection:
                newest = head(connection)
                verified_hash(connection, newest)
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
            name = str(row["number"])
            if (row["number"], row["parent"] or 0) != (number, number - 1):
                self.report(
                    revisions,
                    name,
                    f"is number {number} of the history, with parent {row['parent']}",
                )
            try:
                contents = from_json(row["contents"], f"revision {name}")
                ranges = own_rows(row).ranges
            except MapCorruptError as error:
                self.report(revisions, name, str(error))
                continue
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

    def _brought_by(self, session_key: int) -> Row | None:
        revision = self.shown_again.get(session_key, self.revision_of[sessions][session_key])
        return self.revision_rows.get(revision)

    def result(self) -> CheckReport:
        abandoned = {key for key, row in self.revision_rows.items() if row["status"] == "abandoned"}
        writer = self.database.writer()
        live = "" if writer is None else writer.token
        interrupted = tuple(
            identity
            for key, identity in self.session_ids.items()
            if (revision := self._brought_by(key)) is not None
            and revision["status"] == "open"
            and revision["writer"] != live
        )
        return CheckReport(
            problems=tuple(self.problems),
            rows=self.rows,
            blobs=self.blobs,
            interrupted=interrupted,
            abandoned_rows=sum(
                revision in abandoned
                for table in VERSIONED
                for revision in self.revision_of[table].values()
            ),
        )


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
        checking.session_ids[row["key"]] = session_from_row(row, camera.id).id


def _check_node(checking: _Checking, row: Row) -> None:
    uuid_from_bytes(row["uuid"], "the row")
    checking.landmark_hashes[row["key"]] = (
        row["landmark_hash"],
        row["camera"],
        row["frontend"],
    )
    FrameStatus(row["status"])
    if not np.isfinite(row["driven_m"]):
        raise MapCorruptError(f"driven_m is {row['driven_m']}")


def _check_frame(checking: _Checking, row: Row) -> None:
    expected, camera_key, frontend = checking.landmark_hashes.get(row["node"], (b"", -1, -1))
    camera, kind = checking.cameras.get(camera_key), checking.kinds.get(frontend)
    name = checking.uuids.get((nodes, row["node"]), "?")
    if blob_hash(row["landmarks"]) != expected:
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
        for key in np.unique(getattr(table, name)).tolist():
            fact = checking.reference_problem(revision, nodes, key)
            if fact:
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


def _check_goal(_: _Checking, row: Row) -> None:
    _check_rotation(goal_from_row(row, {row["node"]: _NOBODY}).node_from_goal.rotation)


def _check_vocabulary(checking: _Checking, row: Row) -> None:
    checking.blobs += 1
    if content_digest(row["body"]) != row["hash"]:
        raise MapCorruptError("the vocabulary does not match its hash")


def _check_hidden(checking: _Checking, row: Row) -> None:
    table = metadata.tables.get(row["record"])
    if table is None or row["target"] not in checking.revision_of.get(table, {}):
        raise MapCorruptError(f"hides row {row['target']} of {row['record']}, which is missing")
    revision = checking.revision_rows.get(row["revision"])
    if table is sessions and not row["hidden"] and revision and revision["status"] == "open":
        checking.shown_again[row["target"]] = row["revision"]


def _check_tag(checking: _Checking, row: Row) -> None:
    numbers = {one["number"] for one in checking.revision_rows.values()} - {None}
    if row["number"] is not None and row["number"] not in numbers:
        raise MapCorruptError(f"tag {row['name']} names revision {row['number']}, which is missing")


def _check_words(checking: _Checking, row: Row) -> None:
    if row["node"] not in checking.revision_of[nodes]:
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
    hidden: _check_hidden,
    tags: _check_tag,
    words: _check_words,
    place_blocks: _check_place_block,
}
