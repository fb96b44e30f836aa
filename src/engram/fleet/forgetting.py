"""Retention: which drives, nodes and pictures a map forgets, and how the rest stays connected.

What goes is chosen here; `engram.maps.forgetting` hides it, and erases it later. Edges are composed
over what goes, as downloads compose them over what they leave out.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.config import plain
from engram.errors import ConfigError, InputError
from engram.fleet.download.part import close_gaps
from engram.fleet.download.surroundings import MARGIN_M, Surroundings
from engram.fleet.serving import going_order, node_bytes, patches
from engram.geometry.se3 import SE3
from engram.graph.graph import EDGE_KINDS, labels_of
from engram.graph.model import Clock, Edge, NodeId, SessionId
from engram.graph.pages import GraphPage
from engram.maps.forgetting import (
    Chosen,
    Erased,
    Forgotten,
    NothingToForgetError,
    erase_map,
)
from engram.maps.map import Map
from engram.maps.pages import MapPages
from engram.maps.runs import Runs

_NS_PER_DAY = 86_400 * 10**9
# In larger maps, what connects all that goes may be the whole map.
WHOLE_NODES = 65_536
# So many stretches are bridged at once, and the edges of so many nodes are read.
_GROUP, _AT_ONCE = 128, 4096

Indices: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Retention:
    """What a map is to forget: what all that is given here holds for.

    Attributes:
        sessions: ids of drives, or their beginnings; none for all drives.
        region: x, y and radius of a circle in the map frame, metres; None for everywhere.
        older_than_days: age of drives from their starts; None for any. Drives whose time is unknown
            are not old.
        pictures: whether only pictures go.
        down_to: bytes of the nodes, or per cent of them, that may stay (`budget_from_text`): of all
            this only the nodes go that serve least, and none once the rest takes no more. Both None
            for no such limit.
    """

    sessions: Sequence[str] = ()
    region: tuple[float, float, float] | None = None
    older_than_days: float | None = None
    pictures: bool = False
    down_to: tuple[int | None, float | None] = (None, None)

    def chosen(self, store: Map, now_ns: int) -> Chosen:
        """What that is in a map.

        Args:
            store: the map.
            now_ns: the time, UTC.

        Raises:
            InputError: nothing is given, a session is not in the map, or not enough may go.
        """
        if self == Retention():
            raise InputError(
                "what is to be forgotten? Give --session, --region, --older-than, --down-to or "
                "--pictures"
            )
        named = [store.named_session(one) for one in self.sessions]
        drives = named or list(store.sessions.values())
        if self.older_than_days is not None:
            before_ns = now_ns - int(self.older_than_days * _NS_PER_DAY)
            drives = [one for one in drives if one.clock is Clock.UTC and one.begin_ns < before_ns]
        ids = frozenset(one.id for one in drives)
        if self.down_to != (None, None):
            return Chosen(nodes=self._least_serving(store, ids), pictures=self.pictures)
        if self.region is None:
            return Chosen(sessions=ids, pictures=self.pictures)
        return Chosen(nodes=_within(store, self.region, ids), pictures=self.pictures)

    def _least_serving(self, store: Map, drives: frozenset[SessionId]) -> frozenset[NodeId]:
        """Nodes that go so that the rest takes `down_to`; see `going_order`."""
        nodes, (most_bytes, percent) = store.sized(), self.down_to
        sizes = node_bytes(nodes.sizes)
        of_bytes = int(sizes.sum())
        if percent is not None:
            most_bytes = int(of_bytes * percent / 100)
        assert most_bytes is not None
        if of_bytes <= most_bytes:
            return frozenset()
        if self.pictures:
            _, sizes = nodes.sizes
        may_go = np.array([one.id in drives for one in nodes.sessions], np.bool_)[nodes.session]
        if self.region is not None:
            x_m, y_m, radius_m = self.region
            apart_m = np.hypot(nodes.positions[:, 0] - x_m, nodes.positions[:, 1] - y_m)
            may_go &= apart_m <= radius_m
        if sizes[may_go].sum() < of_bytes - most_bytes:
            raise InputError(
                f"of {of_bytes} bytes of nodes {sizes[may_go].sum()} may go: {most_bytes} are not "
                "reached"
            )
        going = going_order(store, nodes)
        going = going[may_go[going]]
        freed = np.cumsum(sizes[going])
        count = int(np.searchsorted(freed, of_bytes - most_bytes)) + 1
        uuids = nodes.uuids[going[:count]].tobytes()
        return frozenset(NodeId(UUID(bytes=uuids[at : at + 16])) for at in range(0, len(uuids), 16))


def _within(
    store: Map, region: tuple[float, float, float], drives: frozenset[SessionId]
) -> frozenset[NodeId]:
    """The nodes of some drives that lie in a circle."""
    x_m, y_m, radius_m = region
    near = store.lookups.places_near(x_m, y_m, radius_m)
    inside = [
        node
        for node, pose in near.items()
        if np.hypot(pose.translation[0] - x_m, pose.translation[1] - y_m) <= radius_m
    ]
    held = store.lookups.nodes(inside)
    return frozenset(node for node, one in held.items() if one.node.session in drives)


def bridges_over(store: Map, chosen: Chosen, whole: int = WHOLE_NODES) -> list[Edge]:
    """Edges that keep connected what only these nodes connect; see `close_gaps`.

    Args:
        store: the map.
        chosen: what goes.
        whole: in maps of more nodes, each group of nodes that goes is bridged by itself.
    """
    seeds = store.lookups.node_keys(chosen.sessions, chosen.nodes) - 1
    if chosen.pictures or not len(seeds):
        return []
    if store.node_count() <= whole:
        return _bridges(store, seeds, seeds, store.lookups.runs())
    found: dict[tuple[NodeId, NodeId], Edge] = {}
    for group in _groups(store, seeds):
        # Of two groups near each other, either may see the other's chains in part.
        for bridge in _bridges(store, group, seeds, None):
            known = found.get((bridge.a, bridge.b))
            if known is None or np.trace(bridge.covariance) < np.trace(known.covariance):
                found[bridge.a, bridge.b] = bridge
    return [found[pair] for pair in sorted(found)]


def _bridges(store: Map, group: Indices, gone: Indices, runs: Runs | None) -> list[Edge]:
    """Bridges over a group of nodes, given by dense indices, of all those that go."""
    # The far ends of long bridges lie beyond what is read around.
    far = [
        ends[np.linalg.norm(poses[:, 9:], axis=1) >= MARGIN_M].ravel()
        for ends, poses in _edges_at(store.pages, group)
    ]
    seeds = np.unique(np.concatenate([group, *far]))
    around = Surroundings.of(store.pages, runs, seeds, 0.0).found
    uuids = around.uuids.tobytes()
    ids = [NodeId(UUID(bytes=uuids[16 * at : 16 * at + 16])) for at in range(len(around.nodes))]
    return close_gaps(ids, _edges(around, ids), ~np.isin(around.nodes, gone))


def _groups(store: Map, seeds: Indices) -> Iterator[Indices]:
    """Nodes in groups that lie near each other, and that no edge joins, each rising.

    Args:
        store: the map.
        seeds: (S,) dense indices, rising.
    """
    inner = [ends[np.isin(ends, seeds).all(axis=1)] for ends, _ in _edges_at(store.pages, seeds)]
    labels = labels_of(np.searchsorted(seeds, np.concatenate(inner)), len(seeds))
    _, first, label = np.unique(labels, return_index=True, return_inverse=True)
    if len(first) <= _GROUP:
        yield seeds
        return
    nodes = store.sized()
    places = nodes.positions[np.searchsorted(nodes.keys, seeds[first] + 1), :2]
    for joined in patches(places, _GROUP):
        yield seeds[np.isin(label, joined)]


def _edges_at(
    pages: MapPages, some: Indices
) -> Iterator[tuple[NDArray[np.int32], NDArray[np.float64]]]:
    """Ends and transforms of the edges at nodes, by dense indices: see `GraphPages.edges_at`."""
    for start in range(0, len(some), _AT_ONCE):
        yield pages.edges_at(some[start : start + _AT_ONCE])


def _edges(page: GraphPage, ids: Sequence[NodeId]) -> list[Edge]:
    places = np.searchsorted(page.nodes, page.ends)
    return [
        Edge(ids[a], ids[b], EDGE_KINDS[kind], SE3(pose[:9].reshape(3, 3), pose[9:]), covariance)
        for (a, b), kind, pose, covariance in zip(
            places.tolist(), page.kinds.tolist(), page.poses, page.covariances, strict=True
        )
    ]


def forget(
    path: Path, retention: Retention, *, author: str, why: str = "", dry_run: bool = False
) -> Forgotten:
    """Forgets, by a revision that can be reverted; nothing is erased.

    Args:
        path: the map.
        retention: what goes.
        author: the person or robot.
        why: the reason, for `log`.
        dry_run: only report what would go.

    Raises:
        InputError: nothing is to be forgotten, or a session is not in the map.
        NothingToForgetError: the map holds nothing of it.
        MapLockedError: another process writes to the map.
    """
    with Map.open(path, writes=True) as store:
        chosen = retention.chosen(store, time.time_ns())
        return store.forget_nodes(
            chosen,
            bridges_over(store, chosen),
            author=author,
            message="forget" + (f": {why}" if why else ""),
            configuration={"forget": plain(retention)},
            dry_run=dry_run,
        )


@dataclass(frozen=True, slots=True)
class Retained:
    """What `forget_and_erase` did, or would do; None for what was not requested or is not there."""

    forgotten: Forgotten | None
    erased: Erased | None

    @property
    def revision(self) -> int | None:
        """Number of the new revision; None without one."""
        return None if self.forgotten is None else self.forgotten.revision

    def to_dict(self) -> dict[str, Any]:
        """What ``forget --json`` prints."""
        values: dict[str, Any] = plain(self)
        return values

    def text(self) -> str:
        """The result as text."""
        done = [one.text() for one in (self.forgotten, self.erased) if one is not None]
        return "\n".join(done) or "nothing to forget"


def forget_and_erase(
    path: Path, retention: Retention, *, author: str, why: str, erase: bool, dry_run: bool
) -> Retained:
    """Forgets what is chosen, if anything is, then erases all that is forgotten, if requested.

    See `forget` and `erase_map`. A map that holds nothing of what is chosen is a result.
    """
    hidden = None
    if not erase or retention != Retention():
        with suppress(NothingToForgetError):
            hidden = forget(path, retention, author=author, why=why, dry_run=dry_run)
    return Retained(hidden, erase_map(path, dry_run=dry_run) if erase else None)


def region_from_text(text: str | None) -> tuple[float, float, float] | None:
    """A region as it is typed, X,Y,R in metres; None for None.

    Raises:
        ConfigError: it is not one.
    """
    if text is None:
        return None
    x_m, y_m, radius_m = _numbers(text, 3, f"--region is {text!r:.40}, must be X,Y,R in metres")
    return x_m, y_m, radius_m


def age_from_text(text: str | None) -> float | None:
    """Days of an age as it is typed, such as 90d; None for None.

    Raises:
        ConfigError: it is not one.
    """
    if text is None:
        return None
    fault = f"--older-than is {text!r:.40}, must be a number of days such as 90d"
    (days,) = _numbers(text[:-1] if text.endswith("d") else "", 1, fault)
    return days


def _numbers(text: str, count: int, fault: str) -> list[float]:
    """Numbers with commas between them, the last of which is a size.

    Raises:
        ConfigError: there is another number of them, or one is not finite.
    """
    try:
        found = [float(one) for one in text.split(",")]
    except ValueError as error:
        raise ConfigError(fault) from error
    if len(found) != count or not np.isfinite(found).all() or found[-1] <= 0:
        raise ConfigError(fault)
    return found
