"""Where a node comes from, and what refers to it: by look-ups, whatever the size of the map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from sqlalchemy import Connection, func, or_, select

from engram.errors import InputError
from engram.graph.model import NodeId, SessionId
from engram.maps.attempts import page_of, unpack
from engram.maps.marks import counting
from engram.maps.rows import Row, node_from_bytes, uuid_from_bytes, verified
from engram.maps.schema import attempts, edges, hidden, nodes, path_entries, revisions, sessions
from engram.maps.view import View, place_in_history

_HEX = frozenset("0123456789abcdef")
_LISTED = 5


@dataclass(frozen=True, slots=True)
class Origin:
    """A node and its history.

    Attributes:
        node: its id.
        session: of the drive that saved it.
        robot: of that drive.
        stamp_ns: of its frame.
        driven_m: odometry distance from the session's start.
        brought: number of the revision that added it.
        told: (number, hidden) for each later revision that hid it or showed it again.
        edges: number of its visible edges by kind.
        paths: number of visible paths that it is on.
        attempts, matches: number of visible attempts on it, and of those that were accepted.
    """

    node: NodeId
    session: SessionId
    robot: str
    stamp_ns: int
    driven_m: float
    brought: int
    told: tuple[tuple[int, bool], ...]
    edges: Mapping[str, int] = field(default_factory=dict)
    paths: int = 0
    attempts: int = 0
    matches: int = 0

    @property
    def visible(self) -> bool:
        """Whether the node is visible at the chosen revision."""
        return not (self.told and self.told[-1][1])


def origin_of(connection: Connection, view: View, prefix: str) -> Origin:
    """The one node whose UUID begins with `prefix`, hidden ones included.

    Args:
        connection: of the map.
        view: the view of a revision.
        prefix: hexadecimal digits, with or without hyphens.

    Raises:
        InputError: no node or several match, or the prefix is not valid.
    """
    digits = prefix.strip().lower().replace("-", "")
    if not digits or not _HEX.issuperset(digits) or len(digits) > 32:
        raise InputError(f"{prefix!r} is not a UUID or the beginning of one")
    brought = nodes.c.revision.in_(view.revision_keys())
    begins = _between(digits)
    query = select(nodes).where(brought, nodes.c.uuid >= begins[0], nodes.c.uuid <= begins[1])
    rows = list(verified(nodes, connection.execute(query.order_by(nodes.c.uuid))))
    if not rows:
        count = connection.execute(select(func.count()).select_from(nodes).where(brought)).scalar()
        raise InputError(f"none of the map's {count} nodes begins with {prefix!r}")
    if len(rows) > 1:
        listed = ", ".join(str(node_from_bytes(row["uuid"])) for row in rows[:_LISTED])
        more = f" and {len(rows) - _LISTED} more" if len(rows) > _LISTED else ""
        raise InputError(
            f"{len(rows)} nodes begin with {prefix!r}, give more characters: {listed}{more}"
        )
    return _origin(connection, view, rows[0])


def _between(digits: str) -> tuple[bytes, bytes]:
    """The smallest and the largest UUID that begin with `prefix`."""
    return bytes.fromhex(digits.ljust(32, "0")), bytes.fromhex(digits.ljust(32, "f"))


def _origin(connection: Connection, view: View, row: Row) -> Origin:
    number = select(revisions.c.number).where(revisions.c.key == row["revision"])
    owner = select(sessions).where(sessions.c.key == row["session"])
    session = next(verified(sessions, connection.execute(owner)))
    told = (
        select(revisions.c.number, hidden.c.hidden)
        .select_from(hidden.join(revisions, revisions.c.key == hidden.c.revision))
        .where(hidden.c.record == nodes.name, hidden.c.target == row["key"])
        .where(hidden.c.revision.in_(view.revision_keys()))
        .order_by(place_in_history(), hidden.c.key)
    )
    return Origin(
        node=node_from_bytes(row["uuid"]),
        session=SessionId(uuid_from_bytes(session["uuid"], "a session")),
        robot=session["robot"],
        stamp_ns=row["stamp_ns"],
        driven_m=row["driven_m"],
        brought=connection.execute(number).scalar_one(),
        told=tuple((by, bool(hid)) for by, hid in connection.execute(told)),
        edges=_edges(connection, view, row["key"]),
        paths=_paths(connection, view, row["key"]),
        **_attempts(connection, view, row["key"]),
    )


def _edges(connection: Connection, view: View, key: int) -> dict[str, int]:
    """Number of visible edges of a node by kind."""
    rows = view.select(edges).where(or_(edges.c.a == key, edges.c.b == key))
    newest: dict[tuple[int, int, str], Row] = {}
    for row in verified(edges, connection.execute(rows)):
        named = row["a"], row["b"], row["kind"]
        newest.pop(named, None)
        newest[named] = row
    return dict(Counter(row["kind"] for row in counting(connection, view, [*newest.values()])))


def _paths(connection: Connection, view: View, key: int) -> int:
    """Number of visible paths whose entries name a node."""
    rows = view.select(path_entries).where(path_entries.c.node == key)
    found = {(row["path"], row["sequence"]): row["key"] for row in verified(
        path_entries, connection.execute(rows)
    )}  # fmt: skip
    newest: dict[tuple[int, int], int] = {}
    for path in {path for path, _ in found}:
        sequences = [sequence for one, sequence in found if one == path]
        same = view.select(path_entries).where(
            path_entries.c.path == path, path_entries.c.sequence.in_(sequences)
        )
        for row in verified(path_entries, connection.execute(same)):
            newest[path, row["sequence"]] = row["key"]
    return len({named[0] for named, entry in found.items() if newest[named] == entry})


def _attempts(connection: Connection, view: View, key: int) -> dict[str, int]:
    """Number of visible attempts on a node, and of accepted ones."""
    hid = np.array(connection.execute(view.hidden_keys(nodes)).scalars().all(), np.int64)
    here = attempts.c.page == int(page_of(np.array(key)))
    found = {"attempts": 0, "matches": 0}
    if key in hid:
        return found
    for row in verified(attempts, connection.execute(view.select(attempts).where(here))):
        _, table = unpack(row["body"], row["count"])
        tried = np.flatnonzero(table.node == key)
        tried = tried[~np.isin(table.reference[tried], hid)]
        found["attempts"] += len(tried)
        found["matches"] += int(table.accepted[tried].sum())
    return found
