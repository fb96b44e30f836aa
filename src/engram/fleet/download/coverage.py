"""The expected share of a mission's route with a match, given a subset of a map.

Past drives model the mission: each passed places of the map in the light and weather of its own
day. A node matches there under two conditions. First, its session looks alike, with probability
a(s, e) for the past session s and the session e that saved the node. Second, this attempt succeeds,
with probability g(d) at the node's distance d, metres. The first event is common to all nodes of
a session, the second is independent for each node, and sessions are independent of each other:

    P(match) = 1 − Π_e (1 − a(s, e) · (1 − Π_{n of e} (1 − g(d_n)))).

Each past drive is weighted by how closely its daylight resembles the mission's (`daylight`), and
counts only at the places that it passed.

a is estimated from remembered attempts (`affinity`): the successes of s on nodes of e over the
number that g alone predicts. g is the shipped basin. The basin learnt from the map's attempts is
biased here, since far nodes are attempted only after near ones have failed.

P is monotone and submodular in the set of nodes, so the greedy choice of the best node per byte is
near-optimal (Leskovec et al., "Cost-effective outbreak detection in networks", 2007).
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

# Places a metre apart, the spacing of saved nodes (method §5).
_PLACE_M = 1.0
# Nodes farther than this many basin widths are ignored.
_REACH = 2.0
_GATE_RAD = float(np.deg2rad(60.0))
# Nodes lie near their expected position: no slack.
_STRICT = SearchConfig(slack_sigmas=0.0, slack_m=0.0)
# Attempts on nodes of one session fail together more often than independent ones:
# P(second matches | first did not) is 0.2 to 0.3 where g gives 0.5.
# Source: lab/reports/constants.md.
_APART = 0.6
_LEAST_GAIN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Demand:
    """Where the mission may go, weighted by the past drives that model it.

    Attributes:
        places: (L,) int64, dense indices of the nodes that represent places.
        weight: (L, S) weight of being there as session s: the same at all places that the
            session passed and the mission may reach, 0 elsewhere.
    """

    places: NDArray[np.int64]
    weight: Array

    @property
    def total(self) -> float:
        """Total weight of all places: the value of a mission without any match."""
        return float(self.weight.sum())

    @staticmethod
    def of(stock: Stock, options: DownloadOptions, where: Mask | None) -> Demand:
        """Places from all nodes, weights from path memory.

        Args:
            stock: the centre.
            options: when the mission is.
            where: (N,) nodes along its route; None for anywhere.
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
    """Nodes at least a metre apart, and for each node the place that it is at."""
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
    """The expected share of a mission's route with a match, as nodes are added one by one.

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
        """Empties the subset."""
        # (L, S): weight × the chance of no match so far.
        self._missed = self.demand.weight.copy()
        # (L, S_e): the chance that an added node of session e matches, if they look alike.
        self._alike = np.zeros(self.demand.weight.shape)

    def _reach(self, stock: Stock, basin: MatchBasin) -> dict[int, tuple[NDArray[np.int64], Array]]:
        """For each node the places at which it may match, and g there."""
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
        """Increase in the expected number of places with a match if the node were added."""
        if node not in self._reached:
            return 0.0
        places, rates, before = self._state(node)
        missed = self._missed[places]
        return float((missed * (1 - self._less(node, rates, before))).sum())

    def add(self, node: int) -> None:
        """Adds a node to the subset."""
        if node not in self._reached:
            return
        places, rates, before = self._state(node)
        self._missed[places] *= self._less(node, rates, before)
        self._alike[places, self._session_of[node]] = _either(rates, before)

    def _less(self, node: int, rates: Array, before: Array) -> Array:
        """(K, S) factor on the chance of no match at the K places that a node reaches."""
        affinity = self._affinity[:, self._session_of[node]]
        now = _either(rates, before)
        return np.asarray((1 - affinity * now[:, None]) / (1 - affinity * before[:, None]))

    def _state(self, node: int) -> tuple[NDArray[np.int64], Array, Array]:
        places, rates = self._reached[node]
        return places, rates, self._alike[places, self._session_of[node]]

    @property
    def expected_missed(self) -> float:
        """Expected share of the mission's route without a match, given the nodes added so far.

        1 if the mission has no route at all.
        """
        return float(self._missed.sum() / self.demand.total) if self.demand.total else 1.0


def _either(first: Array, second: Array) -> Array:
    """P(A or B) of independent events."""
    return 1 - (1 - first) * (1 - second)


def expected_missed(coverage: Coverage, sent: Mask) -> float:
    """`Coverage.expected_missed` of a subset, (N,) bool."""
    coverage.clear()
    for node in np.flatnonzero(sent).tolist():
        coverage.add(node)
    return coverage.expected_missed


def greedy_order(
    coverage: Coverage, size_bytes: Array, spare: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(N,) all nodes: by gain per byte, each given those before it; then those without gain.

    Lazy: gains only fall, so a node whose recomputed gain is still the highest is the best. Ties go
    to the lower index.

    Args:
        coverage: of the mission; its subset is replaced.
        size_bytes: (N,) float64, bytes of each node.
        spare: (N,) int64, all nodes in the order in which they fill the rest.
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
