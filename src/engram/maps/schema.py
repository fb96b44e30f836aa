"""The tables of a map. Prose: docs/format.md.

Every row has the key of the revision that added it (except cameras and front-ends, whose ids are
hashes) and a checksum over its other columns. References are not declared as foreign keys, since
collecting abandoned rows would then search all referring tables; `engram check` verifies them. Keys
are 64-bit integers in the order of writing.
"""

from __future__ import annotations

from sqlalchemy import (
    REAL,
    Column,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
    UniqueConstraint,
)
from sqlalchemy.schema import SchemaItem
from sqlalchemy.types import TypeEngine

FORMAT_VERSION = 7

# SQLite's INTEGER and REAL are 64 bits wide.
_INT64: TypeEngine[int] = Integer()
_FLOAT64: TypeEngine[float] = REAL()

metadata = MetaData()


def _key() -> Column[int]:
    return Column("key", _INT64, primary_key=True, autoincrement=False)


def _int(name: str, note: str = "", *, nullable: bool = False) -> Column[int]:
    return Column(name, _INT64, nullable=nullable, info={"note": note})


def _float(name: str, note: str = "", *, nullable: bool = False) -> Column[float]:
    return Column(name, _FLOAT64, nullable=nullable, info={"note": note})


def _text(name: str, note: str = "", *, nullable: bool = False) -> Column[str]:
    return Column(name, Text(), nullable=nullable, info={"note": note})


def _bytes(
    name: str, note: str = "", *, nullable: bool = False, size: int | None = None
) -> Column[bytes]:
    """Bytes; `size` of them if all values have equally many."""
    return Column(name, LargeBinary(), nullable=nullable, info={"note": note, "size": size})


def _uuid(note: str = "") -> Column[bytes]:
    return _bytes("uuid", note, size=16)


def _transform(name: str, note: str = "transform") -> Column[bytes]:
    return _bytes(name, note, size=96)


def _table(name: str, *items: SchemaItem) -> Table:
    return Table(name, metadata, *items, _int("checksum"), sqlite_strict=True)


map_format = _table("map_format", _key(), _int("version"), _text("tool_version"))

revisions = _table(
    "revisions",
    _key(),
    _int("number", "NULL until committed; 1, 2, 3 …", nullable=True),
    _text("status", "`open`, `committed`, `abandoned`"),
    _int("parent", "number", nullable=True),
    _text("author"),
    _text("message"),
    _text("tool_version"),
    _text("configuration", "JSON"),
    _text("contents", "JSON: rows brought, by table, and `mapped_m`"),
    _int("opened_ns"),
    _int("committed_ns", nullable=True),
    _text("host"),
    _int("pid"),
    _text("writer", "token of its lock"),
    _text("ranges", "JSON: first and last key of its rows, by table"),
    _text("totals", "JSON: what is visible as of it, below"),
    _text("chain", "content hash as of it, below; empty until committed"),
    UniqueConstraint("number"),
)

cameras = _table(
    "cameras",
    _key(),
    _text("id", "hash of the rest"),
    _float("fx", "px"),
    _float("fy", "px"),
    _float("cx", "px"),
    _float("cy", "px"),
    _float("baseline_m"),
    _int("width"),
    _int("height"),
    _bytes("cam_from_rig", "transform or NULL", nullable=True),
    _text("rectification"),
    UniqueConstraint("id"),
)

frontends = _table(
    "frontends",
    _key(),
    _text("descriptor", "`brief`, `teblid`, `net@` and the start of its weights' SHA-256"),
    _text("hash", "of version and settings"),
    UniqueConstraint("descriptor", "hash"),
)

sessions = _table(
    "sessions",
    _key(),
    _uuid(),
    _int("revision"),
    _text("robot"),
    _int("camera"),
    _int("frontend"),
    _int("start_ns"),
    _text("clock", "`utc`, `relative`, `unknown`"),
    _float("longitude_deg", nullable=True),
    _text("zone", nullable=True),
    UniqueConstraint("uuid"),
)

nodes = _table(
    "nodes",
    _key(),
    _uuid(),
    _int("revision"),
    _int("session"),
    _int("camera"),
    _int("frontend"),
    _int("stamp_ns"),
    _float("driven_m"),
    _text("status", "of the frame"),
    _bytes("landmark_hash", size=16),
    UniqueConstraint("uuid"),
    Index("nodes_by_session", "session"),
)

# A separate table, so that reading the graph does not read the blobs.
frames = _table(
    "frames",
    Column("node", _INT64, primary_key=True, autoincrement=False),
    _int("revision"),
    _bytes("landmarks", "blob"),
    _bytes("thumbnail", "JPEG, grey, or NULL", nullable=True),
)

edges = _table(
    "edges",
    _key(),
    _int("revision"),
    _int("a"),
    _int("b"),
    _text("kind"),
    _transform("a_from_b"),
    _bytes("covariance", "168 bytes: upper triangle of the 6×6 row by row, float64", size=168),
    UniqueConstraint("a", "b", "kind", "revision"),
    Index("edges_by_b", "b"),
)

paths = _table(
    "paths",
    _key(),
    _uuid(),
    _int("revision"),
    _int("session"),
    _int("partial", "1 if some entries stayed elsewhere"),
    UniqueConstraint("uuid"),
)

path_entries = _table(
    "path_entries",
    _key(),
    _int("revision"),
    _int("path"),
    _int("sequence"),
    _int("node"),
    _text("kind"),
    _int("stamp_ns"),
    UniqueConstraint("path", "sequence", "revision"),
    Index("path_entries_by_node", "node"),
)

omissions = _table(
    "omissions",
    _key(),
    _uuid("of a node that was not taken"),
    _int("revision"),
    _int("node", "its equivalent"),
    _transform("node_from_omitted"),
    UniqueConstraint("uuid", "revision"),
)

# Hashes of the landmarks of omitted nodes: a node with the same UUID must have the same landmarks.
omitted_landmarks = _table(
    "omitted_landmarks",
    _key(),
    _uuid("of such a node"),
    _int("revision"),
    _bytes("landmark_hash", size=16),
    UniqueConstraint("uuid", "revision"),
)

attempts = _table(
    "attempts",
    _key(),
    _int("revision"),
    _int("session"),
    _int("page", "of their nodes: from key 128 · page + 1 on"),
    _int("count"),
    _bytes("body", "packed, below"),
    Index("attempts_by_session", "session"),
    Index("attempts_by_page", "page"),
)

statistics = _table(
    "statistics",
    _key(),
    _int("revision"),
    _text("name"),
    _text("body", "JSON"),
    UniqueConstraint("name", "revision"),
)

vocabularies = _table(
    "vocabularies",
    _key(),
    _int("revision"),
    _bytes("hash", "16 bytes"),
    _bytes("body", "below; the newest counts"),
)

hidden = _table(
    "hidden",
    _key(),
    _int("revision"),
    _text("record", "table"),
    _int("target", "key"),
    _int("hidden", "1 hides, 0 shows again"),
    Index("hidden_by_target", "record", "target"),
)

# What may not be taken in again. Rows of the same revision hide what the map had of it.
forgotten = _table(
    "forgotten",
    _key(),
    _int("revision"),
    _text("record", "`sessions`, `nodes`"),
    _uuid(),
    UniqueConstraint("uuid", "revision"),
)

# What is left of rows that were erased: history is verified by their digests. They belong to no
# revision, since they change nothing that is visible.
receipts = _table(
    "receipts",
    _key(),
    _text("record", "table"),
    _int("target", "key that the row had"),
    _int("revision", "its revision"),
    _bytes("uuid", "its UUID, if it had one", nullable=True, size=16),
    _int("count", "1; of a row of attempts, theirs"),
    _bytes("digest", "16 bytes, below; NULL if not in the content hash", nullable=True, size=16),
    _int("forgotten", "revision that forgot it, whose message says why"),
    _int("erased_ns"),
    UniqueConstraint("record", "target"),
)

# Names of revisions. They belong to no revision: setting, moving or removing a tag changes neither
# history nor content hash. Of the rows of one name the newest counts.
tags = _table(
    "tags",
    _key(),
    _text("name", "of its rows the newest counts"),
    _int("number", "of a revision; NULL removes the name", nullable=True),
    _text("author"),
    _text("message"),
    _int("tagged_ns"),
)

# One row: what the rows of tags come to, which no revision counts (`engram.maps.rows`).
tag_tally = _table(
    "tag_tally",
    _key(),
    _int("rows", "of `tags`"),
    _bytes("digest", "16 bytes of the SHA-256 over their keys and checksums, int64 each"),
)

# Words of nodes by a vocabulary (`engram.places`), computed from their landmarks. They follow from
# other rows and belong to no revision.
words = _table(
    "words",
    Column("node", _INT64, primary_key=True, autoincrement=False),
    _bytes("vocabulary", "its hash"),
    _bytes("body", "the distinct words that the node shows, rising, little-endian u16"),
)

# Blocks of 8,192 nodes, by key, of a place recogniser: what a lost robot compares. They follow from
# `words` and landmarks, and belong to no revision.
place_blocks = _table(
    "place_blocks",
    Column("block", _INT64, primary_key=True, autoincrement=False, info={"note": "0, 1, 2 …"}),
    Column("vocabulary", LargeBinary(), primary_key=True, info={"note": "its hash"}),
    Column("recogniser", Text(), primary_key=True, info={"note": "and its model"}),
    Column("part", Text(), primary_key=True, info={"note": "`numbers`, `unreadable`, `body`"}),
    _bytes("content"),
)

# What people set right about sessions: whose record stays. Of one session's rows for the same
# `what`, the newest counts.
amendments = _table(
    "amendments",
    _key(),
    _int("revision"),
    _int("session"),
    _text("what", "`robot`, `zone`, `start`"),
    _text("value", "text; a start in ns, UTC"),
    _int("amended_ns"),
)

# Edges that no longer count: those of this key that measure the same.
removals = _table(
    "removals",
    _key(),
    _int("revision"),
    _int("a"),
    _int("b"),
    _text("kind"),
    _transform("a_from_b"),
    _text("reason"),
    _int("removed_ns"),
)

# Where nodes lie in the map frame. Of one node's rows the newest counts. Cells are of 32 m: see
# `rows.cell_of`.
placements = _table(
    "placements",
    _key(),
    _int("revision"),
    _int("node"),
    _transform("map_from_node"),
    _int("cell"),
    Index("placements_by_node", "node"),
    Index("placements_by_cell", "cell"),
)

# Known positions of nodes in the map frame. Those of the newest revision that has any count.
anchors = _table(
    "anchors",
    _key(),
    _int("revision"),
    _int("node"),
    _float("x_m"),
    _float("y_m"),
    _float("z_m", "NULL if unknown", nullable=True),
    _float("sigma_m"),
    _text("source"),
)

# Named poses, each relative to a node. Of one name the newest counts.
goals = _table(
    "goals",
    _key(),
    _int("revision"),
    _text("name"),
    _int("node"),
    _transform("node_from_goal"),
)

# Which nodes are connected as of the newest revision: runs of visible nodes, each by its first one.
# They follow from other rows and belong to no revision.
runs = _table(
    "runs",
    _key(),
    _int("last", "node"),
    _int("experience", "first node of the chain of odometry edges"),
    _int("component", "first node of its connected component"),
)

# Rows refer to earlier tables only.
VERSIONED: tuple[Table, ...] = (
    sessions,
    nodes,
    frames,
    edges,
    paths,
    path_entries,
    omissions,
    omitted_landmarks,
    attempts,
    statistics,
    vocabularies,
    amendments,
    removals,
    placements,
    anchors,
    goals,
    forgotten,
    hidden,
)
KEYED: tuple[Table, ...] = tuple(table for table in metadata.sorted_tables if "key" in table.c)
