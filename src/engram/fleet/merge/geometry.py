"""Looks for wrong edges in what a merge makes, and may refuse it."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any, TypeAlias

from engram.counts import counted
from engram.errors import RefusedError
from engram.graph.model import EdgeKind, NodeId
from engram.maps import Map
from engram.monitor import Monitor
from engram.repair import Finding, RepairConfig, find_wrong_edges

_Key: TypeAlias = tuple[NodeId, NodeId, EdgeKind]


class GeometryGate:
    """Finds the wrong edges of the fleet map after each merge.

    Args:
        refuses: whether a merge that brings new ones is refused.
        config: what counts as wrong.
    """

    def __init__(self, *, refuses: bool, config: RepairConfig | None = None) -> None:
        self._refuses = refuses
        self._config = config
        self._known: AbstractSet[_Key] = frozenset()

    def look_at(self, place: Path, monitor: Monitor) -> None:
        """Finds the wrong edges that the fleet map has before the first merge."""
        if self._refuses:
            with Map.open(place) as store:
                self._known = {_key(one) for one in self._wrong(store, monitor)}

    def __call__(self, store: Map, source: str, monitor: Monitor) -> list[dict[str, Any]]:
        """The wrong edges of the fleet map with an open merge, as plain values.

        Raises:
            RefusedError: some of them are new.
        """
        wrong = self._wrong(store, monitor)
        new = [one for one in wrong if _key(one) not in self._known]
        if self._refuses and new:
            raise RefusedError(
                f"{source} would add {counted(len(new), 'wrong edge')}, the most certain of them: "
                f"{new[0].text()}; repair it with engram check {source} --geometry --repair"
            )
        self._known = {_key(one) for one in wrong}
        return [one.to_dict() for one in wrong]

    def _wrong(self, store: Map, monitor: Monitor) -> tuple[Finding, ...]:
        if not len(store.graph):
            return ()
        return find_wrong_edges(
            store.graph, store.path_memory, store.frames, self._config, monitor=monitor
        ).wrong


def _key(one: Finding) -> _Key:
    return one.edge.a, one.edge.b, one.edge.kind
