"""The records of a fleet map, in an order that depends only on its content."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.graph.attempts import Attempts
from engram.graph.basin import BasinCounts
from engram.graph.clock import hour_of_day, zone_note
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, Node, NodeId, PathEntry, PathId, Session, SessionId
from engram.maps import Map
from engram.places.words import NodeWords, words_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LISTED = 3


class Stock:
    """A fleet map as of one revision, for selections.

    Attributes:
        store: the map.
        contents: its records in the order of the store.
        sessions: in the order of their starts, then UUIDs.
        nodes: by session, then stamp, then UUID.
        index: place of each node in `nodes`.
        edges: by their ends and kind.
        graph: of these nodes and edges; dense indices are places in `nodes`.
    """

    def __init__(self, store: Map) -> None:
        self.store = store
        self.contents = store.load()
        self.sessions: list[Session] = sorted(
            self.contents.sessions, key=lambda one: (one.start_ns, one.id)
        )
        place = {one.id: at for at, one in enumerate(self.sessions)}
        self.nodes: list[Node] = sorted(
            self.contents.nodes, key=lambda one: (place[one.session], one.stamp_ns, one.id)
        )
        self.index = {node.id: at for at, node in enumerate(self.nodes)}
        self.edges: list[Edge] = sorted(
            self.contents.edges, key=lambda edge: (edge.a, edge.b, edge.kind)
        )
        self.graph = ExperienceGraph()
        for node in self.nodes:
            self.graph.add_node(node)
        self.graph.add_edges(self.edges)
        self.session_of: NDArray[np.int64] = np.array(
            [place[node.session] for node in self.nodes], np.int64
        )

    def __len__(self) -> int:
        return len(self.nodes)

    def everything(self) -> Mask:
        """(N,) bool, all True: every node."""
        return np.ones(len(self), np.bool_)

    @cached_property
    def content_hash(self) -> str:
        """Content hash of the fleet map at this revision."""
        return self.store.content_hash()

    @cached_property
    def words(self) -> NodeWords | None:
        """Words of the nodes; None while the fleet map is empty."""
        kind = self.store.descriptor
        return None if kind is None else words_of(self.store, kind)

    @cached_property
    def node_ids(self) -> list[NodeId]:
        """UUIDs of `nodes`."""
        return [node.id for node in self.nodes]

    @cached_property
    def hours(self) -> Array:
        """(N,) hour of day of each node (method §2.8), NaN if unknown."""
        by_id = {one.id: one for one in self.sessions}
        known = (hour_of_day(by_id[node.session], node.stamp_ns) for node in self.nodes)
        return np.array([np.nan if hour is None else hour for hour in known], np.float64)

    def known_hours(self) -> Array:
        """`hours` (N,), at least one of which is known.

        Raises:
            InputError: all are unknown.
        """
        if not np.isfinite(self.hours).any():
            without = [one for one in self.sessions if hour_of_day(one, one.start_ns) is None]
            listed = ", ".join(f"{one.robot} {str(one.id)[:8]}" for one in without[:_LISTED])
            raise InputError(
                f"{_zones_told(without)}no node of {self.store.location} has a known hour of day: "
                f"{len(without)} of {len(self.sessions)} sessions ({listed}…) have no UTC clock or "
                "neither longitude nor time zone; set it with engram amend, or choose --select "
                "copy, region or route"
            )
        return self.hours

    @cached_property
    def on_path(self) -> dict[PathId, NDArray[np.int64]]:
        """(n,) int64 for each path: dense indices of its nodes in order, once per visit."""
        found: dict[PathId, list[int]] = {}
        for entry in self.contents.path_entries:
            found.setdefault(entry.path, []).append(self.index[entry.node])
        return {path: np.array(nodes, np.int64) for path, nodes in found.items()}

    @cached_property
    def entries(self) -> list[PathEntry]:
        """Path entries by path and sequence."""
        return sorted(self.contents.path_entries, key=lambda entry: (entry.path, entry.sequence))

    @cached_property
    def attempts(self) -> Attempts:
        """Remembered attempts; sessions and nodes are places in `sessions` and `nodes`."""
        made = self.contents.attempts
        place = {one.id: at for at, one in enumerate(self.sessions)}
        session = np.array([place[one.id] for one in self.contents.sessions], np.int32)
        node = np.array([self.index[one.id] for one in self.contents.nodes], np.int32)
        found = replace(
            made,
            session=session[made.session],
            reference=node[made.reference],
            node=node[made.node],
        )
        return found.rows(np.argsort(found.session, kind="stable"))

    @cached_property
    def basin_counts(self) -> BasinCounts:
        """Counts from which match basins are learnt."""
        places = [self.graph.index(node.id) for node in self.contents.nodes]
        return self.contents.basin_counts(self.graph.experiences[places])

    @cached_property
    def sizes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(N,) bytes of the landmarks of each node, and (N,) of its thumbnail."""
        found = self.store.blob_sizes
        both = np.array([found[node] for node in self.node_ids], np.int64).reshape(-1, 2)
        return both[:, 0], both[:, 1]

    def named_node(self, prefix: str) -> int:
        """Dense index of the one node whose UUID begins with `prefix`.

        Raises:
            InputError: no node or several match, or a revert has hidden it.
        """
        origin = self.store.origin(prefix)
        if origin.node not in self.index:
            raise InputError(f"node {origin.node} was reverted in revision {origin.told[-1][0]}")
        return self.index[origin.node]

    def place_of(self, session: SessionId) -> int:
        """Place of a session in `sessions`."""
        return next(at for at, one in enumerate(self.sessions) if one.id == session)


def _zones_told(sessions: Sequence[Session]) -> str:
    """Why the hours of these sessions are unknown although they have zones."""
    notes = {note: None for one in sessions if (note := zone_note(one))}
    return "".join(f"{note}; " for note in notes)
