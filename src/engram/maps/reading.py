"""Reads records from rows: the graph, paths and attempts of a map as of one revision."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Select, func, select

from engram.errors import MapCorruptError
from engram.frontend.blobs import content_digest
from engram.frontend.features import feature_kind
from engram.frontend.frame import DescriptorKind
from engram.geometry.cameras import CameraId, StereoCamera
from engram.graph.graph import EDGE_KINDS, EdgeTable
from engram.graph.model import (
    Amendment,
    EdgeKind,
    Node,
    NodeId,
    Omission,
    PathEntry,
    PathEntryKind,
    PathId,
    Session,
    SessionId,
)
from engram.graph.paths import Attempts
from engram.maps.attempts import unpack_drive
from engram.maps.columns import Columns, read_columns
from engram.maps.marks import removed_measurements, without_removed
from engram.maps.records import MapContents, Revision
from engram.maps.rows import (
    Row,
    amendment_from_row,
    camera_from_row,
    edge_arrays,
    from_json,
    member,
    node_from_bytes,
    session_from_row,
    transform_from_bytes,
    uuid_from_bytes,
    verified,
)
from engram.maps.schema import (
    amendments,
    attempts,
    cameras,
    edges,
    frontends,
    nodes,
    omissions,
    omitted_landmarks,
    path_entries,
    paths,
    removals,
    revisions,
    sessions,
    statistics,
    vocabularies,
)
from engram.maps.view import View, few

# Most numbers per key that a table of all of them may span.
_DENSE = 16
_KEY = sessions.c.key


def load(connection: Connection, view: View) -> MapContents:
    """All records except landmarks.

    Raises:
        MapCorruptError: a row does not match its checksum or points at nothing.
    """
    known_cameras = load_cameras(connection)
    session_by_key = sessions_by_key(connection, view, known_cameras)
    session_ids = {key: one.id for key, one in session_by_key.items()}
    node_keys, node_list = _nodes(connection, view, known_cameras, session_ids)
    used = {one.camera for one in session_by_key.values()} | {one.camera for one in node_list}
    return MapContents(
        cameras={one.id: one for one in known_cameras.values() if one.id in used},
        sessions=tuple(session_by_key.values()),
        nodes=tuple(node_list),
        edges=_edges(connection, view, node_keys, node_list),
        path_entries=_path_entries(connection, view, node_keys, node_list),
        attempts=_attempts(connection, view, list(session_ids), node_keys),
    )


def load_sessions(connection: Connection, view: View) -> tuple[Session, ...]:
    """The drives of the map."""
    return tuple(sessions_by_key(connection, view, load_cameras(connection)).values())


def session_sizes(connection: Connection, view: View) -> dict[SessionId, tuple[int, int]]:
    """Number of nodes and of path entries of each session."""
    known = sessions_by_key(connection, view, load_cameras(connection))
    own = view.select(nodes).with_only_columns(nodes.c.session, func.count())
    saved = _pairs(connection, own.group_by(nodes.c.session))
    places = view.select(path_entries).with_only_columns(
        path_entries.c.path, func.count(path_entries.c.sequence.distinct())
    )
    passed = _pairs(connection, places.group_by(path_entries.c.path))
    owners = view.select(paths).with_only_columns(paths.c.session, paths.c.key)
    path_of = _pairs(connection, owners)
    return {
        one.id: (saved.get(key, 0), passed.get(path_of.get(key, 0), 0))
        for key, one in known.items()
    }


def _pairs(connection: Connection, query: Select[Any]) -> dict[int, int]:
    return dict(map(tuple, connection.execute(query.order_by(None))))


def load_amendments(connection: Connection, view: View) -> tuple[Amendment, ...]:
    """Amendments of the visible sessions; the last of contradicting ones counts."""
    known = sessions_by_key(connection, view, load_cameras(connection))
    return tuple(one for _, one in _amendments(connection, view, known))


def sessions_by_key(
    connection: Connection,
    view: View,
    known_cameras: dict[int, StereoCamera],
    among: Collection[int] | None = None,
) -> dict[int, Session]:
    """Sessions by key, with their amendments applied; of all keys, or of these."""
    parts = [None] if among is None else few(sorted(among))
    queries = (
        view.select(sessions) if part is None else view.select(sessions).where(_KEY.in_(part))
        for part in parts
    )
    recorded = {
        row["key"]: session_from_row(row, _camera_id(known_cameras, row, "session"))
        for query in queries
        for row in verified(sessions, connection.execute(query))
    }
    for key, amendment in _amendments(connection, view, recorded):
        recorded[key] = amendment.applied(recorded[key])
    return recorded


def _amendments(
    connection: Connection, view: View, known: Mapping[int, Session]
) -> list[tuple[int, Amendment]]:
    """Each with the key of its session, in the order in which they count."""
    return [
        (row["session"], amendment_from_row(row, known[row["session"]].id))
        for row in view.rows(connection, amendments)
        if row["session"] in known
    ]


def load_cameras(connection: Connection) -> dict[int, StereoCamera]:
    """All cameras by key."""
    rows = connection.execute(select(cameras).order_by(cameras.c.key))
    return {row["key"]: camera_from_row(row) for row in verified(cameras, rows)}


def load_frontends(connection: Connection) -> dict[int, tuple[DescriptorKind, str]]:
    """Descriptor kind and hash of all front-ends by key."""
    rows = connection.execute(select(frontends).order_by(frontends.c.key))
    return {
        row["key"]: (feature_kind(row["descriptor"]).name, row["hash"])
        for row in verified(frontends, rows)
    }


def descriptor_of(connection: Connection, view: View) -> DescriptorKind | None:
    """The kind of all descriptors of the map; None before its first session."""
    known = load_frontends(connection)
    query = view.select(sessions).with_only_columns(sessions.c.frontend).limit(1)
    key = connection.execute(query).scalar()
    if key is None:
        return None
    if key not in known:
        raise MapCorruptError(f"table frontends: row {key}, of a session, is missing")
    return known[key][0]


def log(connection: Connection, view: View) -> list[Revision]:
    """The visible committed revisions, oldest first."""
    query = (
        select(revisions)
        .where(revisions.c.status == "committed", revisions.c.number <= view.at)
        .order_by(revisions.c.number)
    )
    return [revision_from_row(row) for row in verified(revisions, connection.execute(query))]


def newest_revision(connection: Connection, view: View, number: int) -> Revision | None:
    """The newest visible committed revision up to a number; None if there is none."""
    query = (
        select(revisions)
        .where(revisions.c.status == "committed", revisions.c.number <= min(view.at, number))
        .order_by(revisions.c.number.desc())
        .limit(1)
    )
    for row in verified(revisions, connection.execute(query)):
        return revision_from_row(row)
    return None


def revision_from_row(row: Row) -> Revision:
    """A committed revision."""
    what = f"revision {row['number']}"
    return Revision(
        number=row["number"],
        parent=row["parent"],
        author=row["author"],
        message=row["message"],
        tool_version=row["tool_version"],
        configuration=from_json(row["configuration"], f"{what}: configuration"),
        opened_ns=row["opened_ns"],
        committed_ns=row["committed_ns"],
        host=row["host"],
        contents=from_json(row["contents"], f"{what}: contents"),
    )


def node_count(connection: Connection, view: View) -> int:
    """Number of visible nodes."""
    return _count(connection, view.select(nodes))


def load_statistics(connection: Connection, view: View) -> dict[str, dict[str, Any]]:
    """The newest value of each statistic by name."""
    rows = view.rows(connection, statistics)
    return {row["name"]: from_json(row["body"], f"statistic {row['name']}") for row in rows}


def load_vocabulary(connection: Connection, view: View) -> bytes | None:
    """The newest vocabulary, encoded; None if there is none.

    Raises:
        MapCorruptError: it does not match its hash.
    """
    kept = list(view.rows(connection, vocabularies))
    if not kept:
        return None
    body: bytes = kept[-1]["body"]
    if content_digest(body) != kept[-1]["hash"]:
        raise MapCorruptError("the vocabulary does not match its hash; run engram check")
    return body


def load_omissions(connection: Connection, view: View) -> dict[NodeId, Omission]:
    """Omitted nodes, each with its newest visible equivalent."""
    rows = list(view.rows(connection, omissions))
    if not rows:
        return {}
    query = view.select(nodes).with_only_columns(nodes.c.key, nodes.c.uuid)
    node_ids = {row[0]: node_from_bytes(row[1]) for row in connection.execute(query)}
    landmarks = {
        row["uuid"]: row["landmark_hash"] for row in view.rows(connection, omitted_landmarks)
    }
    found = {}
    for row in rows:
        omitted = NodeId(uuid_from_bytes(row["uuid"], f"omission {row['key']}"))
        if row["node"] in node_ids:
            transform = transform_from_bytes(row["node_from_omitted"], f"omission {omitted}")
            landmark_hash = landmarks.get(row["uuid"])
            found[omitted] = Omission(omitted, node_ids[row["node"]], transform, landmark_hash)
    return found


def frontends_of_sessions(
    connection: Connection, view: View
) -> dict[SessionId, tuple[DescriptorKind, str]]:
    """Descriptor kind and hash of each session's front-end."""
    known = load_frontends(connection)
    found = {}
    for row in view.rows(connection, sessions):
        session = SessionId(uuid_from_bytes(row["uuid"], f"session {row['key']}"))
        if row["frontend"] not in known:
            raise MapCorruptError(f"session {session}: its front-end is missing")
        found[session] = known[row["frontend"]]
    return found


def landmark_hashes(connection: Connection, view: View) -> dict[NodeId, bytes]:
    """Hash of each node's landmarks, including omitted nodes whose hash was stored."""
    found: dict[NodeId, bytes] = {}
    for table in (omitted_landmarks, nodes):
        query = view.select(table).with_only_columns(table.c.uuid, table.c.landmark_hash)
        found |= {node_from_bytes(row[0]): row[1] for row in connection.execute(query)}
    return found


def partial_paths(connection: Connection, view: View) -> frozenset[PathId]:
    """Paths some of whose entries are not in this map."""
    return frozenset(
        PathId(uuid_from_bytes(row["uuid"], f"path {row['key']}"))
        for row in view.rows(connection, paths)
        if row["partial"]
    )


def attempt_tables(
    connection: Connection, view: View, session: int | None = None
) -> dict[int, Attempts]:
    """Remembered attempts by key of their session; of all sessions, or of one."""
    query = view.select(attempts)
    if session is not None:
        query = query.where(attempts.c.session == session)
    found: dict[int, list[Row]] = {}
    for row in verified(attempts, connection.execute(query)):
        found.setdefault(row["session"], []).append(row)
    return {session: unpack_drive(rows) for session, rows in found.items()}


def _nodes(
    connection: Connection,
    view: View,
    known_cameras: dict[int, StereoCamera],
    session_ids: dict[int, SessionId],
) -> tuple[NDArray[np.int64], tuple[Node, ...]]:
    """Keys (N,) and records of the nodes."""
    found = read_columns(connection, view, nodes)
    uuids = found["uuid"].tobytes()
    columns = [found[name].tolist() for name in ("key", "session", "camera", "stamp_ns")]
    records = []
    for at, (key, session, camera, stamp_ns, driven_m) in enumerate(
        zip(*columns, found["driven_m"].tolist(), strict=True)
    ):
        one = node_from_bytes(uuids[16 * at : 16 * at + 16])
        if session not in session_ids:
            raise MapCorruptError(f"node {one}: its session, row {session}, is missing")
        if camera not in known_cameras:
            raise MapCorruptError(f"node {key}: its camera, row {camera}, is missing")
        records.append(
            Node(one, session_ids[session], stamp_ns, known_cameras[camera].id, driven_m)
        )
    return found["key"], tuple(records)


def _camera_id(known: dict[int, StereoCamera], row: Row, what: str) -> CameraId:
    if row["camera"] not in known:
        raise MapCorruptError(f"{what} {row['key']}: its camera, row {row['camera']}, is missing")
    return known[row["camera"]].id


def edges_between(
    connection: Connection, view: View, node_keys: NDArray[np.int64]
) -> tuple[Columns, NDArray[np.int32]]:
    """The E edges between visible nodes: those of hidden nodes are hidden with them.

    Args:
        connection: to the map.
        view: of it.
        node_keys: (N,) int64 keys of the visible nodes.

    Returns:
        Rows of `edges`, and the (E, 2) int32 places of their ends a and b in `node_keys`.
    """
    found = read_columns(connection, view, edges).newest("a", "b", "kind")
    found = without_removed(removed_measurements(view.rows(connection, removals)), found)
    (a, a_seen), (b, b_seen) = (_dense(found[end], node_keys) for end in ("a", "b"))
    seen = np.flatnonzero(a_seen & b_seen)
    return found.rows(seen), np.column_stack([a, b])[seen]


def _edges(
    connection: Connection, view: View, node_keys: NDArray[np.int64], node_list: tuple[Node, ...]
) -> EdgeTable:
    found, ends = edges_between(connection, view, node_keys)
    codes, texts = found.texts["kind"]
    numbers = [EDGE_KINDS.index(member(EdgeKind, text, "edges")) for text in texts]
    return EdgeTable(
        node_list,
        ends,
        np.array(numbers, np.uint8)[codes],
        *edge_arrays(found["a_from_b"], found["covariance"], found["key"]),
    )


def _path_entries(
    connection: Connection, view: View, node_keys: NDArray[np.int64], node_list: tuple[Node, ...]
) -> tuple[PathEntry, ...]:
    path_rows = list(view.rows(connection, paths))
    path_keys = np.array([row["key"] for row in path_rows], np.int64)
    path_ids = [PathId(uuid_from_bytes(row["uuid"], f"path {row['key']}")) for row in path_rows]
    found = read_columns(connection, view, path_entries)
    (path, path_seen), (node, node_seen) = (
        _dense(found[name], keys) for name, keys in (("path", path_keys), ("node", node_keys))
    )
    seen = np.flatnonzero(path_seen & node_seen)
    found = Columns({**found.values, "path": path, "node": node}, found.texts).rows(seen)
    found = found.newest("path", "sequence")
    found = found.rows(np.lexsort((found["sequence"], found["path"])))
    codes, texts = found.texts["kind"]
    kinds = [member(PathEntryKind, text, "path_entries") for text in texts]
    columns = [found[name].tolist() for name in ("path", "sequence", "node", "stamp_ns")]
    return tuple(
        PathEntry(path_ids[path], sequence, node_list[node].id, kinds[code], stamp_ns)
        for path, sequence, node, stamp_ns, code in zip(*columns, codes.tolist(), strict=True)
    )


def _attempts(
    connection: Connection, view: View, session_keys: list[int], node_keys: NDArray[np.int64]
) -> Attempts:
    """All attempts between visible nodes, with keys converted to dense indices."""
    by_session = attempt_tables(connection, view)
    order = [key for key in session_keys if key in by_session]
    found = Attempts.joined([by_session[key] for key in order])
    place = {key: at for at, key in enumerate(session_keys)}
    session = np.repeat(
        np.array([place[key] for key in order], np.int32),
        np.array([len(by_session[key]) for key in order], np.int64),
    )
    reference, reference_seen = _dense(found.reference, node_keys)
    node, node_seen = _dense(found.node, node_keys)
    found = replace(found, session=session, reference=reference, node=node)
    seen = reference_seen & node_seen
    return found if seen.all() else found.rows(seen)


def _dense(
    keys: NDArray[Any], known: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Index of each key in `known`, and whether it is there."""
    if not len(known):
        return np.zeros(len(keys), np.int32), np.zeros(len(keys), np.bool_)
    least, greatest = int(known.min()), int(known.max())
    if greatest - least < _DENSE * len(known):  # as keys are counted up, nearly always
        index_of = np.zeros(greatest - least + 1, np.int32)
        index_of[known - least] = np.arange(len(known), dtype=np.int32)
        index = index_of[np.clip(keys, least, greatest) - least]
    else:
        order = np.argsort(known)
        at = np.minimum(np.searchsorted(known, keys, sorter=order), len(known) - 1)
        index = order[at].astype(np.int32)
    return index, known[index] == keys


def _count(connection: Connection, rows: Select[Any]) -> int:
    return connection.execute(
        select(func.count()).select_from(rows.order_by(None).subquery())
    ).scalar_one()
