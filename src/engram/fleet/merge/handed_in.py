"""A robot's map, as it is handed in to the centre."""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property
from typing import Self

import numpy as np

from engram.graph.model import (
    Edge,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    PathId,
    Session,
    SessionId,
    path_id,
)
from engram.maps import Map


class HandedIn:
    """Everything of a robot's map but its landmarks, in an order that only its content decides.

    Attributes:
        store: the map, open for reading.
        name: its path or address.
        content_hash: of the map.
        contents: all its records.
        sessions: in the order of their starts.
        nodes: by id.
        omissions: nodes that the map itself had omitted, by id.
        frontends: of each session.
        landmark_hashes: of each node, and of those omitted as far as they are known.
        partial_paths: paths of which the map holds some entries only.
    """

    def __init__(self, store: Map, name: str) -> None:
        self.store = store
        self.name = name
        self.content_hash = store.content_hash()
        self.contents = store.load()
        self.sessions: list[Session] = sorted(
            self.contents.sessions, key=lambda session: (session.start_ns, session.id)
        )
        self.nodes = {node.id: node for node in self.contents.nodes}
        self.omissions = store.omissions
        self.frontends = store.frontends
        self.landmark_hashes = store.landmark_hashes
        self.partial_paths = store.partial_paths

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.store.close()

    @property
    def robots(self) -> list[str]:
        """Whose drives these are."""
        return sorted({session.robot for session in self.sessions})

    @cached_property
    def last_iterations(self) -> dict[SessionId, int]:
        """Number of the newest remembered iteration of each session that has any."""
        made = self.contents.attempts
        return {
            session.id: int(made.iteration[rows].max())
            for place, session in enumerate(self.contents.sessions)
            if len(rows := np.flatnonzero(made.session == place))
        }

    @cached_property
    def edges(self) -> list[Edge]:
        """All edges by their keys."""
        return sorted(self.contents.edges, key=lambda edge: (edge.a, edge.b, edge.kind))

    @cached_property
    def edges_of(self) -> dict[NodeId, list[Edge]]:
        """The edges at each node, by their keys."""
        found: dict[NodeId, list[Edge]] = defaultdict(list)
        for edge in self.edges:
            found[edge.a].append(edge)
            found[edge.b].append(edge)
        return found

    @cached_property
    def entries_of(self) -> dict[PathId, list[PathEntry]]:
        """The entries of each path by sequence number."""
        found: dict[PathId, list[PathEntry]] = defaultdict(list)
        for entry in self.contents.path_entries:
            found[entry.path].append(entry)
        return found

    @cached_property
    def relied_on(self) -> frozenset[NodeId]:
        """Nodes that a drive other than their own localised by."""
        paths = {node.id: path_id(node.session) for node in self.contents.nodes}
        return frozenset(
            entry.node
            for entry in self.contents.path_entries
            if entry.kind is not PathEntryKind.SAVED
            and paths.get(entry.node, entry.path) != entry.path
        )

    @cached_property
    def nodes_of(self) -> dict[Session, list[Node]]:
        """The nodes of each session by their stamps."""
        by_id = {session.id: session for session in self.sessions}
        found: dict[Session, list[Node]] = {session: [] for session in self.sessions}
        for node in sorted(self.contents.nodes, key=lambda node: (node.stamp_ns, node.id)):
            found[by_id[node.session]].append(node)
        return found
