"""Which nodes are connected, as of the newest revision: kept from one commit to the next.

Nodes of a drive have successive keys, so that a map has hardly more runs of them than drives. A
commit reads all runs, and no edge but its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, delete, insert, select

from engram.errors import MapCorruptError
from engram.graph.graph import labels_of
from engram.maps.columns import verified_arrays
from engram.maps.rows import sealed
from engram.maps.schema import runs as table

_LABELS = ("experience", "component")

Keys = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """R runs of nodes with successive keys, ascending, a struct of arrays.

    Attributes:
        first, last: (R,) int64, keys of the first and the last node.
        experience: (R,) int64, the first node of their chain of odometry edges within a drive.
        component: (R,) int64, the first node of their connected component.
    """

    first: Keys
    last: Keys
    experience: Keys
    component: Keys

    @staticmethod
    def none() -> Runs:
        """Those of an empty map."""
        return Runs.of(np.zeros(0, np.int64))

    @staticmethod
    def of(nodes: Keys) -> Runs:
        """Those of nodes without edges, (N,) keys ascending."""
        return Runs(nodes, nodes, nodes, nodes)

    @property
    def sizes(self) -> Keys:
        """(R,) int64, number of nodes."""
        return self.last - self.first + 1

    @property
    def largest(self) -> int:
        """Number of nodes of the largest component."""
        if not len(self.first):
            return 0
        _, which = np.unique(self.component, return_inverse=True)
        return int(np.bincount(which, self.sizes).max())

    def find(self, nodes: Keys) -> NDArray[np.intp]:
        """(K,) the run of each node; -1 of a node that is in none."""
        if not len(self.first):
            return np.full(len(nodes), -1, np.intp)
        at = np.searchsorted(self.first, nodes, side="right") - 1
        inside = (at >= 0) & (nodes <= self.last[at])
        return np.where(inside, at, -1)

    def agrees(self, other: Runs | None) -> bool:
        """Whether they are equal."""
        return other is not None and all(map(np.array_equal, self._arrays(), other._arrays()))

    def with_nodes(self, nodes: Keys) -> Runs:
        """These and new nodes, (N,) keys ascending, none of which is in a run."""
        parts = zip(self._arrays(), (nodes,) * 4, strict=True)
        both = Runs(*(np.concatenate(part) for part in parts))
        return both._rows(np.argsort(both.first, kind="stable"))

    def stretches(self, experience: int) -> list[tuple[int, int]]:
        """First and last node of each run of an experience."""
        at = np.flatnonzero(self.experience == experience)
        return list(zip(self.first[at].tolist(), self.last[at].tolist(), strict=True))

    def without(self, nodes: Keys) -> Runs:
        """These without some of their nodes, (N,) keys."""
        found = self._cut(nodes)
        return found._rows(np.flatnonzero(~np.isin(found.first, nodes)))._named()

    def with_chains(self, chains: Sequence[Keys]) -> Runs:
        """These, where the nodes of each chain, (N,) keys, are an experience by themselves."""
        found = self._cut(np.concatenate([np.zeros(0, np.int64), *chains]))
        experience = found.experience.copy()
        for number, chain in enumerate(chains):
            experience[found.find(chain)] = -1 - number
        return replace(found, experience=experience)._named()

    def with_components(self, parts: Sequence[Keys]) -> Runs:
        """These, where the experiences of each part, (N,), are a component by themselves."""
        component = self.component.copy()
        for number, part in enumerate(parts):
            component[np.isin(self.experience, part)] = -1 - number
        return replace(self, component=component)._named()

    def _named(self) -> Runs:
        """These, with experiences and components named by their first nodes."""
        labels = []
        for known in (self.experience, self.component):
            _, least, which = np.unique(known, return_index=True, return_inverse=True)
            labels.append(self.first[least][which])
        return Runs(self.first, self.last, *labels)

    def _cut(self, nodes: Keys) -> Runs:
        """These, with a run of its own for each of some nodes, (N,) keys."""
        first = np.unique(np.concatenate([self.first, nodes, nodes + 1]))
        at = self.find(first)
        first, at = first[at >= 0], at[at >= 0]
        last = np.minimum(
            np.append(first[1:] - 1, np.iinfo(np.int64).max)[: len(at)], self.last[at]
        )
        return Runs(first, last, self.experience[at], self.component[at])

    def joined(self, chained: Keys, ends: Keys) -> Runs:
        """These, joined by edges between their nodes.

        Args:
            chained: (C, 2) the ends of odometry edges within drives.
            ends: (E, 2) the ends of all edges.
        """
        experience = self._merged(self.experience, chained)
        component = self._merged(self.component, ends)
        goes_on = np.zeros(len(self.first), np.bool_)
        goes_on[1:] = self.first[1:] == self.last[:-1] + 1
        for labels in (experience, component):
            goes_on[1:] &= labels[1:] == labels[:-1]
        begins = np.flatnonzero(~goes_on)
        ends_at = np.append(begins[1:], len(self.first))[: len(begins)] - 1
        return Runs(self.first[begins], self.last[ends_at], experience[begins], component[begins])

    def regrouped(self, after: Runs) -> list[tuple[int, int]]:
        """First and last node of the runs whose experience has other nodes than `after` says.

        Nodes that only one of them has do not count.
        """
        starts = np.unique(np.concatenate([self.first, after.first]))
        ours, theirs = self.find(starts), after.find(starts)
        both = (ours >= 0) & (theirs >= 0)
        pairs = np.column_stack([self.experience[ours[both]], after.experience[theirs[both]]])
        pairs = np.unique(pairs, axis=0)
        repeated = [
            np.isin(column, names[counts > 1])
            for column in pairs.T
            for names, counts in [np.unique(column, return_counts=True)]
        ]
        rows = np.isin(self.experience, pairs[np.any(repeated, axis=0), 0])
        return list(zip(self.first[rows].tolist(), self.last[rows].tolist(), strict=True))

    def changes(self, after: Runs) -> tuple[Keys, Runs]:
        """Keys of the rows that `after` has not or otherwise, and its rows to write instead."""
        ours, theirs = (np.column_stack(one._arrays()) for one in (self, after))
        known = set(map(tuple, ours.tolist()))
        new = np.array([tuple(row) not in known for row in theirs.tolist()], np.bool_)
        kept = set(map(tuple, theirs.tolist()))
        gone = [row[0] for row in ours.tolist() if tuple(row) not in kept]
        return np.array(gone, np.int64), after._rows(np.flatnonzero(new))

    def _merged(self, labels: Keys, ends: Keys) -> Keys:
        """(R,) the labels after a merge of those of the ends, each group's the least of it."""
        if not len(ends):
            return labels
        names, which = np.unique(labels, return_inverse=True)
        groups = labels_of(which[self.find(ends.ravel())].reshape(-1, 2), len(names))
        least = np.full(int(groups.max()) + 1, np.iinfo(np.int64).max)
        np.minimum.at(least, groups, names)
        return np.asarray(least[groups][which])

    def _arrays(self) -> tuple[Keys, Keys, Keys, Keys]:
        return self.first, self.last, self.experience, self.component

    def _rows(self, rows: NDArray[np.intp]) -> Runs:
        return Runs(*(one[rows] for one in self._arrays()))


def load_runs(connection: Connection) -> Runs | None:
    """The stored runs; None if they are damaged: they can be worked out again."""
    found = connection.execute(select(table).order_by(table.c.key)).cursor
    assert found is not None
    try:
        arrays = verified_arrays(table, list(found.fetchall()))
    except MapCorruptError:
        return None
    return Runs(*(arrays[name] for name in ("key", "last", *_LABELS)))


def save_runs(connection: Connection, before: Runs | None, after: Runs) -> None:
    """Writes what changed, or everything where nothing is known."""
    if before is None:
        connection.execute(delete(table))
        gone, new = np.zeros(0, np.int64), after
    else:
        gone, new = before.changes(after)
    if len(gone):
        connection.execute(delete(table).where(table.c.key.in_(gone.tolist())))
    rows = list(_rows(new))
    if rows:
        connection.execute(insert(table), rows)


def _rows(runs: Runs) -> Iterable[dict[str, int]]:
    names = ("key", "last", *_LABELS)
    for values in np.column_stack(runs._arrays()).tolist():
        yield sealed(table, dict(zip(names, values, strict=True)))
