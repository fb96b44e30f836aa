"""The records of a download: which of the fleet map's go along with the chosen nodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engram.fleet.download.bridges import close_gaps
from engram.fleet.download.stock import Mask, Stock
from engram.graph.model import (
    Amendment,
    Edge,
    NodeId,
    Omission,
    PathEntry,
    PathId,
    Session,
    path_id,
)
from engram.maps import RevisionWriter, StoredNode
from engram.monitor import Monitor


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A part of a fleet map, complete in itself.

    Attributes:
        stock: the fleet map.
        sent: (N,) bool, which of its nodes go along.
        bridges: composed edges that close the gaps.
        whole: whether omissions go along, as they do with a copy of everything.
        thumbnails: whether thumbnails go along.
    """

    stock: Stock
    sent: Mask
    bridges: list[Edge]
    whole: bool
    thumbnails: bool

    @staticmethod
    def of(stock: Stock, sent: Mask, *, whole: bool, thumbnails: bool) -> Part:
        """The part with these nodes; its gaps are closed (`close_gaps`)."""
        bridges = close_gaps(stock.node_ids, stock.edges, sent)
        return Part(stock, sent, bridges, whole, thumbnails)

    def __len__(self) -> int:
        return int(self.sent.sum())

    @property
    def node_ids(self) -> list[NodeId]:
        """UUIDs of the nodes, in the order of the stock."""
        return [self.stock.node_ids[at] for at in np.flatnonzero(self.sent)]

    @property
    def sessions(self) -> list[Session]:
        """Sessions that saved, passed or attempted a sent node; all of a whole map."""
        wanted = self._sessions_wanted()
        return [one for at, one in enumerate(self.stock.sessions) if wanted[at]]

    @property
    def amendments(self) -> list[Amendment]:
        """Amendments of the sessions."""
        sent = {one.id for one in self.sessions}
        return [one for one in self.stock.store.amendments if one.session in sent]

    def stored(self, lacking: Mask | None = None) -> Iterator[StoredNode]:
        """The nodes with their blobs.

        Args:
            lacking: (N,) bool, which of them are wanted; None for all.
        """
        wanted = self.sent if lacking is None else self.sent & lacking
        nodes = [self.stock.nodes[at] for at in np.flatnonzero(wanted)]
        for one in self.stock.store.frames.stored(nodes):
            yield one if self.thumbnails else replace(one, thumbnail=None)

    def edges(self) -> Iterator[Edge]:
        """Edges between sent nodes, then bridges."""
        index, sent = self.stock.index, self.sent
        yield from (one for one in self.stock.edges if sent[index[one.a]] and sent[index[one.b]])
        yield from self.bridges

    def entries(self) -> Iterator[PathEntry]:
        """Path entries at sent nodes, by path and sequence."""
        index, sent = self.stock.index, self.sent
        return (one for one in self.stock.entries if sent[index[one.node]])

    def omissions(self) -> list[Omission]:
        """Omissions that go along, by the UUID of the omitted node."""
        return [one for _, one in sorted(self.stock.store.omissions.items())] if self.whole else []

    def partial_paths(self) -> set[PathId]:
        """Paths of which some entries are left out, now or by an earlier download."""
        on_path = self.stock.on_path
        left = {path for path, nodes in on_path.items() if not self.sent[nodes].all()}
        return left | set(self.stock.store.partial_paths)

    def attempt_rows(self) -> NDArray[np.intp]:
        """(A,) intp: rows of the stock's attempts whose two nodes are sent."""
        made = self.stock.attempts
        return np.flatnonzero(self.sent[made.reference] & self.sent[made.node])

    def add_session(self, writer: RevisionWriter, session: Session, partial: set[PathId]) -> bool:
        """Writes a session; returns whether it was new.

        Args:
            writer: of the map that receives the part.
            session: one of `sessions`.
            partial: `partial_paths`.
        """
        descriptor, frontend = self.stock.store.frontends[session.id]
        return writer.add_session(
            session,
            self.stock.contents.cameras[session.camera],
            descriptor=descriptor,
            frontend=frontend,
            partial=path_id(session.id) in partial,
        )

    def write(self, writer: RevisionWriter, monitor: Monitor) -> None:
        """Writes all records into an empty map, owners first."""
        partial = self.partial_paths()
        for session in self.sessions:
            self.add_session(writer, session, partial)
        for amendment in self.amendments:
            writer.add_amendment(amendment)
        for stored in self.stored():
            writer.copy_node(stored)
            monitor.advance()
        for edge in self.edges():
            writer.add_edge(edge)
        for entry in self.entries():
            writer.add_path_entry(entry)
        self.write_attempts(writer, self.attempt_rows())
        for omission in self.omissions():
            writer.add_omission(omission)
        if self.stock.store.vocabulary is not None:
            writer.put_vocabulary(self.stock.store.vocabulary)

    def write_attempts(self, writer: RevisionWriter, rows: NDArray[np.intp]) -> None:
        """Writes rows, (A,) intp, of the stock's attempts, session by session."""
        kept = self.stock.attempts.rows(rows)
        for at, session in enumerate(self.stock.sessions):
            own = np.flatnonzero(kept.session == at)
            if len(own):
                writer.copy_attempts(session.id, kept.rows(own), self.stock.node_ids)

    def _sessions_wanted(self) -> Mask:
        stock = self.stock
        if self.sent.all():
            return np.ones(len(stock.sessions), np.bool_)
        wanted = np.zeros(len(stock.sessions), np.bool_)
        wanted[stock.session_of[self.sent]] = True
        wanted[stock.attempts.session[self.attempt_rows()]] = True
        for at, session in enumerate(stock.sessions):
            nodes = stock.on_path.get(path_id(session.id))
            if nodes is not None and self.sent[nodes].any():
                wanted[at] = True
        return wanted
