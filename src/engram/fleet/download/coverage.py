"""What a subset of a map promises to a mission: the expected share of its way with a match.

Past drives stand for the drive to come. Each went along places of the map and was, at each, in the
light and weather of its own day. Whether a node would match there is told by two things: whether
its session looks alike there at all, with probability a(s, e) for the past session s and the
session e that saved the node; and, if so, whether this very attempt succeeds, with probability
g(d) at the node's distance d. Nodes of one session look alike or do not together; given that they
do, each is an attempt of its own; sessions are taken as independent:

    P(match) = 1 − Π_e (1 − a(s, e) · (1 − Π_{n of e} (1 − g(d_n)))).

Past drives count by how near in daylight they are to the mission (`daylight`), each with the
places that it itself came past: a place that one drive alone came past counts as little as it.

a is learnt from remembered attempts (`affinity`): successes of s on nodes of e over what g alone
would have given, held to the average for their difference in hour of day, and that to how others
got on with e. g has the shape of the shipped basin. The one learnt from the map's attempts will
not do here: far nodes are attempted where near ones have failed, so that it falls off a cliff.

Adding a node never lowers P, and helps the less the more is there already (monotone and
submodular), so taking the best node per byte again and again comes close to the best subset there
is (Leskovec et al., "Cost-effective outbreak detection in networks", 2007).
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.fleet.download.affinity import affinities
from engram.fleet.download.daylight import importance
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.stock import Mask, Stock
from engram.geometry import SE3
from engram.graph.basin import MatchBasin
from engram.graph.model import path_id
from engram.graph.neighbourhood import Search, SearchConfig

Array = NDArray[np.float64]

# Places a metre apart, the spacing of saved nodes (SPEC §5).
_PLACE_M = 1.0
# Nodes farther than this share of the basin give nothing that counts.
_REACH = 2.0
_GATE_RAD = float(np.deg2rad(60.0))
# A node is near where it is expected: no slack.
_STRICT = SearchConfig(slack_sigmas=0.0, slack_m=0.0)
# Attempts on nodes of one session that looks alike fail together oftener than by chance: P(second
# matches | first did not) was 0.2 to 0.3 where g says 0.5 (`village`, 12 drives with all nodes).
_APART = 0.6
_LEAST_GAIN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Demand:
    """Where and as whom the mission may find itself.

    Attributes:
        places: (L,) dense indices of the nodes that stand for places.
        weight: (L, S) how much being there as session s counts: the same at all places that the
            session came past and the mission may come to, 0 elsewhere.
    """

    places: NDArray[np.int64]
    weight: Array

    @property
    def total(self) -> float:
        """What there is to miss."""
        return float(self.weight.sum())

    @staticmethod
    def of(stock: Stock, options: DownloadOptions, where: Mask | None) -> Demand:
        """Places from all nodes, weights from path memory.

        Args:
            stock: the centre.
            options: when the mission is.
            where: (N,) nodes along its way; None for anywhere.
        """
        places, place_of = _places(stock)
        weight = np.zeros((len(places), len(stock.sessions)))
        counts = importance(stock, options)
        for at, session in enumerate(stock.sessions):
            nodes = stock.on_path.get(path_id(session.id), np.zeros(0, np.int64))
            weight[np.unique(place_of[nodes]), at] = counts[at]
        if where is not None:
            weight[~np.isin(np.arange(len(places)), place_of[where])] = 0.0
        return Demand(places, weight)


def _places(stock: Stock) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes no closer to each other than a metre, and for each node the place that it is at."""
    place_of = np.full(len(stock), -1, np.int64)
    distance_m = np.full(len(stock), np.inf)
    places: list[int] = []
    for node in range(len(stock)):
        if place_of[node] >= 0:
            continue
        near = stock.graph.neighbourhood(
            node, SE3.identity(), np.zeros((6, 6)), Search(_PLACE_M, _GATE_RAD, config=_STRICT)
        )
        closer = near.distance_m < distance_m[near.nodes]
        place_of[near.nodes[closer]] = len(places)
        distance_m[near.nodes[closer]] = near.distance_m[closer]
        place_of[node], distance_m[node] = len(places), 0.0
        places.append(node)
    return np.array(places, np.int64), place_of


class Coverage:
    """The expected share of a mission's way with a match, as nodes are added one by one.

    Args:
        stock: the centre.
        demand: of the mission.

    Attributes:
        demand: of the mission.
    """

    def __init__(self, stock: Stock, demand: Demand) -> None:
        self.demand = demand
        focal_px = float(np.median([camera.fx for camera in stock.contents.cameras.values()] or 1))
        basin = MatchBasin.of(focal_px)
        self._affinity = affinities(stock, basin)
        self._session_of = stock.session_of
        self._reached = self._reach(stock, basin)
        self.clear()

    def clear(self) -> None:
        """No node is sent any more."""
        # (L, S): weight × the chance of no match so far.
        self._missed = self.demand.weight.copy()
        # (L, S_e): the chance that a node of session e that was added matches, if they look alike.
        self._alike = np.zeros(self.demand.weight.shape)

    def _reach(self, stock: Stock, basin: MatchBasin) -> dict[int, tuple[NDArray[np.int64], Array]]:
        """For each node the places that it may be matched at, and g there."""
        found: dict[int, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
        wanted = np.flatnonzero(self.demand.weight.sum(axis=1) > 0)
        for place in wanted.tolist():
            near = stock.graph.neighbourhood(
                int(self.demand.places[place]),
                SE3.identity(),
                np.zeros((6, 6)),
                Search(max(_REACH * basin.basin_m, _PLACE_M), _GATE_RAD, config=_STRICT),
            )
            rates = _APART * basin.success_rate(near.along_m, near.across_m)
            for node, rate in zip(near.nodes.tolist(), rates.tolist(), strict=True):
                found[node][0].append(place)
                found[node][1].append(rate)
        return {node: (np.array(at), np.array(g)) for node, (at, g) in found.items()}

    def gain(self, node: int) -> float:
        """By how many places the expected number with a match would rise."""
        if node not in self._reached:
            return 0.0
        places, rates, before = self._state(node)
        missed = self._missed[places]
        return float((missed * (1 - self._less(node, rates, before))).sum())

    def add(self, node: int) -> None:
        """The node is sent."""
        if node not in self._reached:
            return
        places, rates, before = self._state(node)
        self._missed[places] *= self._less(node, rates, before)
        self._alike[places, self._session_of[node]] = _either(rates, before)

    def _less(self, node: int, rates: Array, before: Array) -> Array:
        """(K, S) by what factor the chance of no match falls at the places that a node reaches."""
        affinity = self._affinity[:, self._session_of[node]]
        now = _either(rates, before)
        return np.asarray((1 - affinity * now[:, None]) / (1 - affinity * before[:, None]))

    def _state(self, node: int) -> tuple[NDArray[np.int64], Array, Array]:
        places, rates = self._reached[node]
        return places, rates, self._alike[places, self._session_of[node]]

    @property
    def expected_missed(self) -> float:
        """Expected share of the mission's way without a match, of what was added so far.

        1 where the mission has no way at all.
        """
        return float(self._missed.sum() / self.demand.total) if self.demand.total else 1.0


def _either(first: Array, second: Array) -> Array:
    """The chance that one of two things happens."""
    return 1 - (1 - first) * (1 - second)


def expected_missed(coverage: Coverage, sent: Mask) -> float:
    """`Coverage.expected_missed` of a subset alone."""
    coverage.clear()
    for node in np.flatnonzero(sent).tolist():
        coverage.add(node)
    return coverage.expected_missed


def greedy_order(
    coverage: Coverage, size_bytes: Array, spare: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(N,) all nodes: by gain per byte, each given those before it; then what nothing asks for.

    Lazy: gains only fall, so a node whose gain is still the highest after it was worked out anew
    is the best. Ties go to the lower index.

    Args:
        coverage: of the mission; what it holds is replaced.
        size_bytes: (N,) what each node takes.
        spare: (N,) all nodes in the order in which they fill up what is left.
    """
    coverage.clear()
    waiting = [(-coverage.gain(node) / size, node) for node, size in enumerate(size_bytes)]
    heapq.heapify(waiting)
    order: list[int] = []
    while waiting:
        _, node = heapq.heappop(waiting)
        gain = coverage.gain(node)
        if gain <= _LEAST_GAIN:
            continue
        entry = (-gain / size_bytes[node], node)
        if waiting and entry > waiting[0]:
            heapq.heappush(waiting, entry)
            continue
        coverage.add(node)
        order.append(node)
    taken = set(order)
    order += [node for node in spare.tolist() if node not in taken]
    return np.array(order, np.int64)
