"""Weak spots of a map: where, and at which hours, the next drives will hardly be localised.

What past drives left behind says it: the paths of their matches, the nodes that they saved where
nothing matched, and their attempts. The route is cut into places, the day into hours. The chance
that a drive misses a place at an hour is a rate of past drives with a Beta prior:

    (a·u + Σ w·m) / (a + Σ w)

Each past drive that passed the place, or the places next to it, is one trial. It weighs w by how
like its light was to that of the hour. m is the share of the place that it missed; a miss weighs
less, the farther the drive had been lost by then, as it says little about the places where a drive
stays lost. A drive that maps leaves nodes where it missed: m counts by the share of like drives
that the map already had, (b + e)/(b + e + l), with b of them before and l since. Thus the first
drive of a night is no evidence against the night, and what is missed again and again stays weak.
Where nothing like it was driven, the prior u remains.

What is expected to be missed at a place and an hour is this rate times the length of the place,
the share of drives that pass it, and the share of drives at that hour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import PUBLIC, check_bounds
from engram.graph.clock import day_of_year, hour_of_day, sun_height_deg
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    EdgeKind,
    NodeId,
    PathEntry,
    PathEntryKind,
    Session,
    SessionId,
    path_id,
)
from engram.graph.paths import Attempts
from engram.maps.map import Map

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

HOURS = 24
_HOUR_NS = 3_600_000_000_000


@dataclass(frozen=True, slots=True)
class WeakSpotsConfig:
    """How weak spots are found. Source: lab/reports/weak-spots.md."""

    latitude_deg: (
        Annotated[
            float,
            Meta(ge=-90, le=90, description="degrees north, for the sun; none: by the hour alone"),
            PUBLIC,
        ]
        | None
    ) = None
    share_percent: Annotated[
        float,
        Meta(gt=0, le=100, description="share of route and hours that is named"),
        PUBLIC,
    ] = 10.0
    least_percent: Annotated[
        float, Meta(ge=0, le=100, description="least share missed of what is named")
    ] = 3.0
    cell_m: Annotated[float, Meta(ge=1, description="length of a place, m")] = 20.0
    reach_m: Annotated[
        float, Meta(gt=0, description="m within which nodes that look the same way are one place")
    ] = 8.0
    pool_m: Annotated[
        float, Meta(ge=0, description="m along the drive over which evidence decays e-fold")
    ] = 5.0
    stray_m: Annotated[
        float, Meta(gt=0, description="m that a drive was lost over which a miss decays e-fold")
    ] = 50.0
    alike_h: Annotated[
        float, Meta(gt=0, description="standard deviation of similar hours, the night excepted")
    ] = 1.25
    alike_deg: Annotated[
        float, Meta(gt=0, description="the same of the sun's height, from dusk to a high sun")
    ] = 5.0
    unknown: Annotated[
        float, Meta(gt=0, lt=1, description="share missed where no similar drive exists, u")
    ] = 0.2
    prior_drives: Annotated[float, Meta(gt=0, description="weight of that share, a, drives")] = 0.5
    mending: Annotated[float, Meta(gt=0, description="similar drives assumed at first, e")] = 0.05
    weak_counts: Annotated[
        float, Meta(ge=0, le=1, description="share of a miss for which a weak match counts")
    ] = 0.1
    usual_drives: Annotated[
        float, Meta(gt=0, description="drives, spread over the day, before hours are usual")
    ] = 4.0

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The route, cut into P places: stretches of the drives that saved it first.

    Attributes:
        of_node: (N,) int64, place of each node of the graph; -1 of one without a place.
        session: (P,) int64, number in the graph of the drive along which the place is measured.
        from_m, to_m: (P,) float64, odometry distance from that drive's start, metres.
        node: (P,) int64, dense index of its first node.
        points_m: (P, 2) float64, its middle, x and y in the map frame, metres.
    """

    of_node: Whole
    session: Whole
    from_m: Array
    to_m: Array
    node: Whole
    points_m: Array

    def __len__(self) -> int:
        return len(self.node)

    @property
    def length_m(self) -> Array:
        """(P,) metres."""
        return self.to_m - self.from_m

    def along(self, session: int, from_m: float, to_m: float) -> NDArray[np.bool_]:
        """(P,) whether each place lies between two distances of a drive, by its number, metres."""
        inside = (self.from_m >= from_m) & (self.to_m <= to_m)
        return np.asarray(inside & (self.session == session))

    def pooling(self, pool_m: float) -> Array:
        """(P, P) weight of each place's evidence at each other of the same drive."""
        middle_m = (self.from_m + self.to_m) / 2
        apart_m = np.abs(middle_m[:, None] - middle_m)
        apart_m[self.session[:, None] != self.session] = np.inf
        if not pool_m:
            return np.eye(len(self))
        weight = np.exp(-apart_m / pool_m)
        weight[weight < 0.01] = 0.0
        return np.asarray(weight)


def places_of(opened: Map, config: WeakSpotsConfig) -> Places:
    """Cuts the route of a map into places, in the order in which it was driven first."""
    graph, poses = opened.graph, [opened.placements.get(node.id) for node in opened.graph.nodes]
    placed = np.array([pose is not None for pose in poses], np.bool_)
    known = [pose for pose in poses if pose is not None]
    points_m, ahead = np.full((2, len(graph), 2), np.nan)
    points_m[placed] = np.array([pose.translation[:2] for pose in known]).reshape(-1, 2)
    ahead[placed] = np.array([pose.rotation[:2, 2] for pose in known]).reshape(-1, 2)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    finder = _Finder(config, graph, points_m, ahead, graph.components())
    of_node = np.full(len(graph), -1, np.int64)
    for node in np.flatnonzero(placed).tolist():
        of_node[node] = finder.place(node)
    driven = [graph.driven_m[nodes] for nodes in finder.founders]
    return Places(
        of_node,
        np.array([graph.sessions[nodes[0]] for nodes in finder.founders], np.int64),
        np.array([one.min() for one in driven], np.float64),
        np.array([one.max() for one in driven], np.float64) + _SPACING_M,
        np.array([nodes[0] for nodes in finder.founders], np.int64),
        np.array([points_m[nodes].mean(axis=0) for nodes in finder.founders]).reshape(-1, 2),
    )


# A node stands for the route up to the next one, m (method §5).
_SPACING_M = 1.0
# Nodes within this of each other along one drive are no second visit, m.
_OWN_M = 30.0
_ALIKE_COS = float(np.cos(np.deg2rad(60.0)))


@dataclass(slots=True)
class _Finder:
    """Which place each node is at: that of the nearest earlier node that looks the same way.

    Attributes:
        points_m, ahead: (N, 2) float64, places in the map frame, metres, and headings.
        part: (N,) int32, connected parts of the map.
        founders: of each place the nodes that are at no earlier one.
    """

    config: WeakSpotsConfig
    graph: ExperienceGraph
    points_m: Array
    ahead: Array
    part: NDArray[np.int32]
    founders: list[list[int]] = field(default_factory=list)
    _numbers: dict[tuple[int, int], int] = field(default_factory=dict)
    _squares: dict[tuple[int, ...], list[tuple[int, int]]] = field(default_factory=dict)

    def place(self, node: int) -> int:
        """The place of a node; a new one where no place is near."""
        square = tuple((self.points_m[node] // self.config.reach_m).astype(int).tolist())
        known = self._near(node, square)
        if known is not None:
            return known
        session, driven_m = int(self.graph.sessions[node]), float(self.graph.driven_m[node])
        key = session, int(driven_m // self.config.cell_m)
        number = self._numbers.setdefault(key, len(self.founders))
        if number == len(self.founders):
            self.founders.append([])
        self.founders[number].append(node)
        self._squares.setdefault((int(self.part[node]), *square), []).append((node, number))
        return number

    def _near(self, node: int, square: tuple[int, ...]) -> int | None:
        x, y = square
        others = [
            one
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            for one in self._squares.get((int(self.part[node]), x + i, y + j), ())
        ]
        if not others:
            return None
        nodes, places = np.array(others).T
        apart_m = np.linalg.norm(self.points_m[nodes] - self.points_m[node], axis=1)
        driven_m, sessions = self.graph.driven_m, self.graph.sessions
        again = (sessions[nodes] != sessions[node]) | (
            np.abs(driven_m[nodes] - driven_m[node]) > _OWN_M
        )
        alike = self.ahead[nodes] @ self.ahead[node] > _ALIKE_COS
        apart_m[~(again & alike)] = np.inf
        nearest = int(np.argmin(apart_m))
        return int(places[nearest]) if apart_m[nearest] <= self.config.reach_m else None


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """What drives met, one step of a path or one iteration of attempts a row, in order.

    Attributes:
        session: (K,) int64, place of the drive in the map's list.
        stamp_ns: (K,) int64.
        place: (K,) int64, -1 without one.
        missed: (K,) float64, 0 where a node matched, else the weight of the miss, 1 where the
            drive has just been lost.
        weak, saved: (K,) bool, whether the match was weak, and whether a node was saved.
    """

    session: Whole
    stamp_ns: Whole
    place: Whole
    missed: Array
    weak: NDArray[np.bool_]
    saved: NDArray[np.bool_]

    @staticmethod
    def of(opened: Map, places: Places, config: WeakSpotsConfig) -> _Steps:
        """The steps of all drives that are at places."""
        whole, none = np.zeros(0, np.int64), np.zeros(0, np.bool_)
        parts = [_Steps(whole, whole, whole, np.zeros(0), none, none)]
        for number, session in enumerate(opened.sessions):
            made = opened.attempts.rows(opened.attempts.session == number)
            entries = opened.path_memory.entries(path_id(session))
            parts.append(_of_path(opened.graph, number, entries, made, places))
            parts.append(_of_attempts(opened.sessions[session], number, entries, made, places))
        parts = [replace(one, missed=one.missed * one._fading(config.stray_m)) for one in parts]
        names = [one.name for one in fields(_Steps)]
        joined = {name: np.concatenate([getattr(one, name) for one in parts]) for name in names}
        return _Steps(**{name: column[joined["place"] >= 0] for name, column in joined.items()})

    def _fading(self, stray_m: float) -> Array:
        """(K,) falls with the distance since the last match, of some steps of one drive."""
        step = np.arange(len(self.missed))
        last = np.maximum.accumulate(np.where(self.missed > 0, -1, step)) if len(step) else step
        return np.exp(-np.maximum(step - last - 1, 0) * _SPACING_M / stray_m)


def _of_attempts(
    session: Session, number: int, entries: Sequence[PathEntry], made: Attempts, places: Places
) -> _Steps:
    """The iterations of a drive's attempts, at the places that the robot took itself to be at."""
    iterations, first = np.unique(made.iteration, return_index=True)
    matched = np.zeros(len(iterations), np.bool_)
    np.logical_or.at(matched, np.searchsorted(iterations, made.iteration), made.accepted)
    # Attempts have no stamps: they are spread evenly over the drive.
    ends_ns = [one.stamp_ns for one in (entries[0], entries[-1])] if entries else []
    first_ns, last_ns = ends_ns or [session.start_ns] * 2
    none = np.zeros(len(iterations), np.bool_)
    return _Steps(
        np.full(len(iterations), number),
        np.linspace(first_ns, last_ns, len(iterations)).astype(np.int64),
        places.of_node[made.reference[first]],
        (~matched).astype(np.float64),
        none,
        none,
    )


def _of_path(
    graph: ExperienceGraph, number: int, entries: Sequence[PathEntry], made: Attempts,
    places: Places,
) -> _Steps:  # fmt: skip
    """The entries of a drive's path, and what it passed between them without leaving anything."""
    nodes = [graph.index(one.node) for one in entries]
    saved = np.array([one.kind is PathEntryKind.SAVED for one in entries], np.bool_)
    references = set(made.reference.tolist())
    weak = np.zeros(len(entries), np.bool_)
    for at in np.flatnonzero(saved).tolist():
        # A frame that matched weakly is tied to the node that it matched, where the drive goes on.
        # Where nothing matched it goes on from the saved node: that is its next reference.
        if references and nodes[at] not in references:
            ties = graph.edges_of(nodes[at], EdgeKind.TIE)
            weak[at] = any(edge.b == entries[at].node for edge in ties)
    place = places.of_node[np.array(nodes, np.int64)]
    skipped, before = _skipped(place, places)
    stamps_ns = np.array([one.stamp_ns for one in entries], np.int64)
    return _Steps(
        np.full(len(entries) + len(skipped), number),
        np.insert(stamps_ns, before, stamps_ns[before]),
        np.insert(place, before, skipped),
        np.insert((saved & ~weak).astype(np.float64), before, 1.0),
        np.insert(weak, before, values=False),
        np.insert(saved, before, values=False),
    )


def _skipped(place: Whole, places: Places) -> tuple[Whole, Whole]:
    """Places (K,) that a path passed without leaving anything, once a metre, and the entry after.

    A robot that saves no nodes leaves nothing where it is lost, but the place where it was found
    again.

    Args:
        place: (E,) of its entries, -1 without one.
    """
    known = np.flatnonzero(place >= 0)
    empty = np.zeros(0, np.int64)
    found, after = [empty], [empty]
    for a, b in zip(known[:-1].tolist(), known[1:].tolist(), strict=True):
        between = np.arange(place[a] + 1, place[b])
        drives = places.session[place[a] : place[b] + 1]
        if len(between) and (drives == drives[0]).all():
            each = np.ceil(places.length_m[between]).astype(np.int64)
            found.append(np.repeat(between, each))
            after.append(np.full(int(each.sum()), b))
    return np.concatenate(found), np.concatenate(after)


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """What U passes met at P places. A pass is what a drive drove in an hour.

    Attributes:
        hour, day: (U,) float64, hour of day and days since the first of January; NaN if unknown.
        order: (U,) int64, rank in time.
        seen: (U, P) float64, counts of steps at each place, with a match or without one.
        missed, weak: (U, P) float64, sum of the weights of those without a match, and counts of
            those with a weak one.
        saved: (U, P) bool, whether the pass left nodes there.
    """

    hour: Array
    day: Array
    order: Whole
    seen: Array
    missed: Array
    weak: Array
    saved: NDArray[np.bool_]

    @staticmethod
    def of(opened: Map, places: Places, config: WeakSpotsConfig) -> History:
        """What the drives of a map left behind."""
        steps, sessions = _Steps.of(opened, places, config), list(opened.sessions.values())
        starts_ns = np.array([one.start_ns for one in sessions], np.int64)
        hours = (steps.stamp_ns - starts_ns[steps.session]) // _HOUR_NS
        passes, row = np.unique(
            np.column_stack([steps.session, hours]), axis=0, return_inverse=True
        )

        def summed(values: NDArray[Any]) -> Array:
            sums = np.zeros((len(passes), len(places)))
            np.add.at(sums, (row.ravel(), steps.place), values)
            return sums

        hour, day, begin_ns = np.full((3, len(passes)), np.nan)
        for number, (session, since) in enumerate(passes.tolist()):
            one = sessions[session]
            stamp_ns = one.start_ns + since * _HOUR_NS
            known = hour_of_day(one, stamp_ns)
            begin_ns[number] = stamp_ns + one.shift_ns
            if known is not None:
                hour[number], day[number] = known, day_of_year(stamp_ns + one.shift_ns)
        return History(
            hour,
            day,
            np.argsort(np.argsort(begin_ns, kind="stable")),
            summed(np.ones(len(row))),
            summed(steps.missed),
            summed(steps.weak),
            summed(steps.saved) > 0,
        )

    def __len__(self) -> int:
        return len(self.hour)

    def and_mapped(self, hour: float) -> History:
        """This history, and a drive of the newest one's day that maps all places at an hour."""
        newest = int(np.argmax(self.order))
        nothing, places = np.zeros((1, self.seen.shape[1])), self.seen.shape[1]
        return History(
            np.append(self.hour, hour),
            np.append(self.day, self.day[newest]),
            np.append(self.order, self.order[newest] + 1),
            np.vstack([self.seen, nothing + 1]),
            np.vstack([self.missed, nothing]),
            np.vstack([self.weak, nothing]),
            np.vstack([self.saved, np.ones((1, places), np.bool_)]),
        )


# Between these hours, solar time, it is night wherever the sun sets at all.
_NIGHT_TO_H, _NIGHT_FROM_H = 3.0, 21.0
# Heights of the sun are clipped to these: from civil dusk to where shadows hardly matter.
_DUSK_DEG, _HIGH_DEG = -6.0, 20.0
# With the sun's height known, hours only tell morning from evening.
_SIDE_H = 5.0


@dataclass(frozen=True, slots=True)
class Lights:
    """How like the light of two times is.

    Attributes:
        hour, day: (T,) float64, hour of day, and days since the first of January.
    """

    hour: Array
    day: Array

    def alike(self, other: Lights, config: WeakSpotsConfig) -> Array:
        """(T, O) weights: 1 in equal light, falling to 0; 1 where a time is unknown."""
        if config.latitude_deg is None:
            apart = _night_left_out(self.hour, other.hour) / config.alike_h
        else:
            own, others = (
                np.clip(
                    sun_height_deg(one.day, one.hour, config.latitude_deg), _DUSK_DEG, _HIGH_DEG
                )
                for one in (self, other)
            )
            height = np.subtract.outer(own, others) / config.alike_deg
            dark = (own[:, None] <= _DUSK_DEG) & (others <= _DUSK_DEG)
            hours = np.abs((np.subtract.outer(self.hour, other.hour) + 12) % 24 - 12)
            apart = np.hypot(height, np.where(dark, 0.0, hours / _SIDE_H))
        return np.exp(-0.5 * np.nan_to_num(apart) ** 2)


def _night_left_out(hour: Array, other: Array) -> Array:
    """(T, O) hours between hours of day, of which those of the night do not count."""
    day_h = _NIGHT_FROM_H - _NIGHT_TO_H
    since = np.minimum((hour - _NIGHT_TO_H) % HOURS, day_h)
    others = np.minimum((other - _NIGHT_TO_H) % HOURS, day_h)
    apart = np.abs(np.subtract.outer(since, others))
    return np.minimum(apart, day_h - apart)


@dataclass(frozen=True, slots=True, eq=False)
class Weakness:
    """How much of each place is probably missed, by hour.

    Attributes:
        rate: (P, 24) float64, share of the place that a drive will probably miss at that hour.
        demand_m: (P, 24) float64, metres that the next drive drives there then: length × share of
            drives that pass × share of drives at that hour.
        like: (P, 24) float64, sum of the weights of past drives there, by how like their light was.
        lost, weak: (P, 24) float64, that sum of those that did not match, or weakly, as far as that
            still counts.
    """

    rate: Array
    demand_m: Array
    like: Array
    lost: Array
    weak: Array

    @property
    def expected_m(self) -> Array:
        """(P, 24) metres that the next drive will probably not be localised there then."""
        return self.rate * self.demand_m


def weakness_of(
    places: Places, history: History, config: WeakSpotsConfig, hours: Sequence[int] = ()
) -> Weakness:
    """How weak each place of a map is at each hour.

    Args:
        hours: hours of day, 0 to 23, at which robots will drive; none: as they did.
    """
    now, then = _times(history)
    alike = now.alike(then, config)
    still = _still_counts(history, then.alike(then, config), config)
    passed = (history.seen > 0).astype(np.float64)
    pooling = places.pooling(config.pool_m)
    seen = np.maximum(history.seen, 1.0)
    like, lost, weak = (
        (alike @ counts @ pooling).T
        for counts in (passed, still * history.missed / seen, still * history.weak / seen)
    )
    failed = config.prior_drives * config.unknown + lost + config.weak_counts * weak
    often = passed.mean(axis=0) if len(history) else np.ones(len(places))
    demand_m = (places.length_m * often)[:, None] * _hours_driven(history, config, hours)
    return Weakness(failed / (config.prior_drives + like), demand_m, like, lost, weak)


def _times(history: History) -> tuple[Lights, Lights]:
    """The hours of the newest drive's day, in their middle, and the times of all passes."""
    today = float(history.day[np.argmax(history.order)]) if len(history) else 0.0
    now = Lights(np.arange(0.5, HOURS, dtype=np.float64), np.full(HOURS, np.nan_to_num(today)))
    return now, Lights(history.hour, history.day)


def _still_counts(history: History, alike: Array, config: WeakSpotsConfig) -> Array:
    """(U, P) how far each miss is still evidence: less, the more like drives left nodes since."""
    earlier = history.order < history.order[:, None]
    saved = history.saved.astype(np.float64)
    before = (alike * earlier) @ saved
    since = (alike * ~earlier) @ saved
    return np.asarray((before + config.mending) / (before + since + config.mending))


def _hours_driven(history: History, config: WeakSpotsConfig, hours: Sequence[int]) -> Array:
    """(24,) share of drives at each hour, which sum to 1."""
    if hours:
        share = np.zeros(HOURS)
        share[np.array(hours)] = 1.0
        return np.asarray(share / share.sum())
    known = history.hour[np.isfinite(history.hour)].astype(int)
    counts = np.bincount(known, minlength=HOURS) + config.usual_drives / HOURS
    return np.asarray(counts / counts.sum())


def named(
    weakness: Weakness, places: Places, config: WeakSpotsConfig, hours: Sequence[int] = ()
) -> NDArray[np.bool_]:
    """(P, 24) bool: the cells of most expected metres, up to a share of route and hours.

    Args:
        hours: hours of day at which robots will drive; none: all.
    """
    size_m = np.zeros(weakness.rate.shape)
    size_m[:, np.array(hours or range(HOURS))] = places.length_m[:, None]
    worth = weakness.expected_m / np.maximum(places.length_m, _SPACING_M)[:, None]
    order = np.argsort(-worth, axis=None, kind="stable")
    taken_m = np.cumsum(size_m.ravel()[order])
    chosen = np.zeros(size_m.size, np.bool_)
    chosen[order[taken_m <= config.share_percent / 100 * size_m.sum() + 1e-9]] = True
    chosen &= (size_m.ravel() > 0) & (weakness.rate.ravel() >= config.least_percent / 100)
    return chosen.reshape(size_m.shape)


class Why(StrEnum):
    """Why a spot is weak."""

    NEVER = "never driven in such light"
    SELDOM = "seldom driven in such light"
    LOST = "driven and not localised"
    WEAK = "matched weakly"


@dataclass(frozen=True, slots=True)
class Spot:
    """A stretch of the route at some hours.

    Attributes:
        session: the drive along which the stretch is measured.
        from_m, to_m: odometry distance from its start, metres.
        node: the stretch's first node.
        goal, goal_m: the goal nearest to its middle, and how far it is; None without goals.
        hours: first hour of day, and the one at which it ends, above 24 past midnight.
        missed: share of the stretch that a drive at those hours will probably miss.
        expected: this, as a share of all that the next drive will probably miss.
        like_drives: past drives there in such light, on average.
    """

    session: SessionId
    from_m: float
    to_m: float
    node: NodeId
    goal: str | None
    goal_m: float | None
    hours: tuple[int, int]
    missed: float
    expected: float
    like_drives: float
    why: Why


@dataclass(frozen=True, slots=True)
class Advice:
    """The drive that would mend most.

    Attributes:
        hours: first hour of day at which to drive, and the one at which that ends.
        session: the drive along which the stretch is measured.
        from_m, to_m: the stretch, metres from that drive's start.
        mends: share of all that is expected to be missed that would be localised after it.
    """

    hours: tuple[int, int]
    session: SessionId
    from_m: float
    to_m: float
    mends: float


@dataclass(frozen=True, slots=True, eq=False)
class WeakSpots:
    """Where and when the next drives will probably not be localised.

    Attributes:
        drives: of the map.
        unknown_hours: how many of these have no known hour, and count at every hour.
        route_m: length of the route, metres.
        missed: share of the next drive that will probably not be localised.
        named_share: share of route and hours that the spots are.
        spots: the weakest first.
        advice: None for a map without a route.
    """

    revision: int
    drives: int
    unknown_hours: int
    route_m: float
    missed: float
    named_share: float
    spots: Sequence[Spot]
    advice: Advice | None
    places: Places
    weakness: Weakness

    def to_dict(self) -> dict[str, Any]:
        """What ``weak-spots --json`` prints."""
        names = ("revision", "drives", "unknown_hours", "route_m", "missed", "named_share")
        return {
            **{name: getattr(self, name) for name in names},
            "spots": [_plain(one) for one in self.spots],
            "advice": None if self.advice is None else _plain(self.advice),
        }


def _plain(one: Spot | Advice) -> dict[str, Any]:
    ids = {"session": str(one.session)}
    if isinstance(one, Spot):
        ids |= {"node": str(one.node), "why": str(one.why)}
    return {**asdict(one), **ids, "hours": list(one.hours)}


def find_weak_spots(
    opened: Map, config: WeakSpotsConfig | None = None, hours: Sequence[int] = ()
) -> WeakSpots:
    """The weak spots of a map.

    Args:
        hours: hours of day, 0 to 23, at which robots will drive; none: all, as often as they did.
    """
    config = config or WeakSpotsConfig()
    places = places_of(opened, config)
    history = History.of(opened, places, config)
    weakness = weakness_of(places, history, config, hours)
    chosen = named(weakness, places, config, hours)
    total_m, driven_m = weakness.expected_m.sum(), weakness.demand_m.sum()
    every = len(hours) or HOURS
    cells = _Cells(opened, places, weakness, config)
    return WeakSpots(
        revision=opened.revision,
        drives=len(opened.sessions),
        unknown_hours=sum(
            hour_of_day(one, one.start_ns) is None for one in opened.sessions.values()
        ),
        route_m=float(places.length_m.sum()),
        missed=float(total_m / driven_m) if driven_m else 0.0,
        named_share=float(
            places.length_m @ chosen.sum(axis=1) / max(places.length_m.sum() * every, 1e-9)
        ),
        spots=sorted(cells.spots(chosen), key=lambda one: -one.expected),
        advice=cells.advice(history),
        places=places,
        weakness=weakness,
    )


# Of what a drive would mend, the share that the stretch holds that is proposed.
_MOST = 0.9
# Shares missed by which spots are told apart, and fewest like drives that are more than none.
_CLASSES = (0.1, 0.2, 0.4, 0.7)
_FEW_DRIVES = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """The cells of place and hour of a map."""

    opened: Map
    places: Places
    weakness: Weakness
    config: WeakSpotsConfig

    def spots(self, chosen: NDArray[np.bool_]) -> Iterator[Spot]:
        """The (P, 24) chosen cells, those that adjoin each other and are alike as one."""
        left = set(zip(*(axis.tolist() for axis in np.nonzero(chosen)), strict=True))
        while left:
            spot, waiting, kind = set[tuple[int, int]](), [min(left)], self._kind(*min(left))
            while waiting:
                place, hour = cell = waiting.pop()
                if cell not in left or self._kind(*cell) != kind:
                    continue
                left.remove(cell)
                spot.add(cell)
                waiting += [(place, (hour + step) % HOURS) for step in (-1, 1)]
                waiting += [(other, hour) for other in self._next_to(place)]
            yield self._spot(sorted(spot), kind[0])

    def _kind(self, place: int, hour: int) -> tuple[Why, int]:
        """Why a cell is weak, and how much so: cells of one spot are of one kind."""
        cell, weakness = (place, hour), self.weakness
        lost, weak = (
            float(weakness.lost[cell]),
            self.config.weak_counts * float(weakness.weak[cell]),
        )
        why = Why.NEVER if weakness.like[cell] < _FEW_DRIVES else Why.SELDOM
        if max(lost, weak) > self.config.prior_drives * self.config.unknown:
            why = Why.LOST if lost >= weak else Why.WEAK
        return why, int(np.digitize(weakness.rate[cell], _CLASSES))

    def _next_to(self, place: int) -> list[int]:
        session = self.places.session
        near = [one for one in (place - 1, place + 1) if 0 <= one < len(session)]
        return [one for one in near if session[one] == session[place]]

    def _spot(self, cells: Sequence[tuple[int, int]], why: Why) -> Spot:
        rows, columns = np.array(cells).T
        weakness, first, last = self.weakness, int(rows.min()), int(rows.max())
        expected = weakness.expected_m[rows, columns]
        weight = np.maximum(expected, 1e-12)
        goal = self._goal(self.places.points_m[first : last + 1].mean(axis=0))
        return Spot(
            self._session(first),
            float(self.places.from_m[first]),
            float(self.places.to_m[last]),
            self.opened.graph.node(int(self.places.node[first])).id,
            *goal,
            _span(columns),
            float(np.average(weakness.rate[rows, columns], weights=weight)),
            float(expected.sum() / weakness.expected_m.sum()),
            float(np.average(weakness.like[rows, columns], weights=weight)),
            why,
        )

    def advice(self, history: History) -> Advice | None:
        """The hours and the stretch in which one more drive, mapped, would mend most."""
        if not len(self.places) or not len(history):
            return None
        expected_m = self.weakness.expected_m
        mended_m = []
        for hour in range(HOURS):
            after = weakness_of(self.places, history.and_mapped(hour + 0.5), self.config)
            mended_m.append((self.weakness.rate - after.rate) * self.weakness.demand_m)
        by_hour = np.array([one.sum() for one in mended_m])
        best = int(np.argmax(by_hour))
        session, first, last = self._stretch(mended_m[best].sum(axis=1))
        mends = mended_m[best][first : last + 1].sum() / max(float(expected_m.sum()), 1e-12)
        return Advice(
            _around(best, by_hour >= _MOST * by_hour[best]),
            session,
            float(self.places.from_m[first]),
            float(self.places.to_m[last]),
            float(mends),
        )

    def _stretch(self, mended_m: Array) -> tuple[SessionId, int, int]:
        """The shortest run of places, along one drive, that holds most of (P,) metres mended."""
        drives = self.places.session
        totals = np.bincount(drives, weights=mended_m)
        rows = np.flatnonzero(drives == np.argmax(totals))
        sums = np.concatenate([[0.0], np.cumsum(mended_m[rows])])
        ends = np.searchsorted(sums, sums[:-1] + _MOST * sums[-1] - 1e-12)
        starts = np.flatnonzero(ends < len(sums))
        length_m = self.places.to_m[rows[ends[starts] - 1]] - self.places.from_m[rows[starts]]
        at = int(starts[np.argmin(length_m)])
        return self._session(int(rows[0])), int(rows[at]), int(rows[ends[at] - 1])

    def _session(self, place: int) -> SessionId:
        return self.opened.graph.session(int(self.places.session[place]))

    def _goal(self, point_m: Array) -> tuple[str | None, float | None]:
        """The goal nearest to a point, (2,) metres in the map frame, and its distance, metres."""
        found = []
        for name, goal in sorted(self.opened.goals.items()):
            pose = self.opened.frame.locate(goal)
            found.append((float(np.hypot(pose.x_m - point_m[0], pose.y_m - point_m[1])), name))
        return (None, None) if not found else (min(found)[1], min(found)[0])


def _span(hours: NDArray[np.int64]) -> tuple[int, int]:
    """The shortest span that holds all of some hours of day; its end may lie above 24."""
    known = np.unique(hours)
    gaps = np.diff(np.concatenate([known, [known[0] + HOURS]]))
    last = int(np.argmax(gaps))
    first = int(known[(last + 1) % len(known)])
    return first, first + HOURS - int(gaps[last]) + 1


def _around(hour: int, chosen: NDArray[np.bool_]) -> tuple[int, int]:
    """The run of (24,) chosen hours around one of them; the whole day is 0 to 24."""
    if chosen.all():
        return 0, HOURS
    first = last = hour
    while chosen[(first - 1) % HOURS]:
        first -= 1
    while chosen[(last + 1) % HOURS]:
        last += 1
    return first % HOURS, first % HOURS + last - first + 1
