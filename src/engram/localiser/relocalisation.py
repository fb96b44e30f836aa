"""Relocalisation of a lost robot: which nodes to attempt, by what several frames look like.

`PlaceBelief` is a Bayes filter over the nodes of a graph. One frame may look like several places;
several frames along a stretch of road seldom do. The filter adds each frame's evidence to that of
earlier frames, which odometry carries along the edges of the graph. A failed match attempt counts
against its node and the nodes next to it. The filter keeps the best explanation of each node
(Viterbi), not the sum over all: a sum over paths would favour nodes with many edges. It only orders
the attempts; a match decides.

Evidence is measured in standard deviations over all nodes. FAB-MAP treats neighbouring features as
independent, so its log-likelihoods differ by hundreds between places: unscaled, the first frame
would decide alone.

Source: method §6; Cummins & Newman, FAB-MAP, IJRR 27(6), 2008, §4.6 carries the belief by a motion
model between neighbouring places in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import ConfigError
from engram.frontend.frame import Frame
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph, HalfEdges
from engram.places.recognisers import (
    RECOGNISERS,
    PlaceRecogniser,
    recogniser_named,
    recogniser_names,
)
from engram.places.vocabulary import Vocabulary
from engram.places.words import NodeWords, PlaceBook
from engram.plugins import where_from

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BeliefConfig:
    """Settings of `PlaceBelief`.

    Attributes:
        step_m: distance after which the belief moves along the edges, metres. Evidence in between
            is weighted by distance, so that a standing robot gains none. Source: the spacing of
            saved nodes.
        slack_m: standard deviation of the distance between a robot and the node it matches, metres.
        reach_m: longest edge that counts as a step, metres.
        leap: largest deficit of a node against the best one, for places that no edge leads to.
        most_nodes: nodes of a graph of which all are carried along the edges.
        most_carried: of a larger graph, so many, the likeliest.
        refuted: cost of a failed attempt to its node.
        refuted_beside: cost of a failed attempt to each node joined to it by an edge.
    """

    step_m: float = 1.0
    slack_m: float = 1.0
    reach_m: float = 5.0
    leap: float = 8.0
    most_nodes: int = 20_000
    most_carried: int = 200
    refuted: float = 2.0
    refuted_beside: float = 0.5


class PlaceBelief:
    """Adds up the evidence of live frames for each node of a graph.

    Args:
        graph: the experience graph; may grow between calls.
    """

    def __init__(self, graph: ExperienceGraph, config: BeliefConfig | None = None) -> None:
        self.config = config or BeliefConfig()
        self._graph = graph
        self._steps: HalfEdges | None = None
        self._of_edges = 0
        self.forget()

    def forget(self) -> None:
        """Discards the evidence of earlier frames."""
        self._belief: Array = np.zeros(0)
        self._moved_m: Array = np.zeros(3)
        self._since_m = np.inf

    def carry_on(self, motion: SE3 | None) -> None:
        """Moves the belief by `motion`, prev_from_curr; None, if unknown, discards it."""
        if motion is None:
            self.forget()
        elif len(self._belief):
            self._moved_m = self._moved_m + motion.translation
            self._since_m += motion.distance_m
            if math.sqrt(self._moved_m @ self._moved_m) >= self.config.step_m:
                self._carry()

    def observe(self, evidence: Array) -> Array:
        """Adds the evidence of one frame.

        Args:
            evidence: (N,) float64, score of the frame at each node, on any linear scale.

        Returns:
            (N,) float64, the likelihood of each node: log-probabilities up to scale and constant.
        """
        spread = float(evidence.std()) if len(evidence) else 0.0
        scaled = (evidence - evidence.mean()) / spread if spread > 0 else np.zeros_like(evidence)
        self._belief = self._of_all(len(evidence))
        weight = min(1.0, self._since_m / self.config.step_m)
        now: Array = self._belief + scaled
        self._belief = self._belief + weight * scaled
        self._since_m = 0.0
        return now

    def refute(self, nodes: Sequence[int]) -> None:
        """Counts failed attempts to match the last frame against these nodes, by dense index."""
        config, known = self.config, len(self._belief)
        held = [node for node in nodes if node < known]
        steps = self._graph.half_edges_from(np.unique(np.array(held, np.int64)), config.reach_m)
        for node in held:
            self._belief[node] -= config.refuted
            beside = np.unique(steps.targets[steps.sources == node])
            self._belief[beside[beside < known]] -= config.refuted_beside

    def _of_all(self, count: int) -> Array:
        """The belief, extended by new nodes of the graph at its minimum."""
        new = count - len(self._belief)
        least = self._belief.min(initial=0.0)
        return np.concatenate([self._belief, np.full(new, least)]) if new else self._belief

    def _carry(self) -> None:
        """Moves the belief along the edges, in steps about as long as they are."""
        moved_m = math.sqrt(self._moved_m @ self._moved_m)
        count = max(1, round(moved_m / self.config.step_m))
        motion = self._moved_m / count
        stay = float(motion @ motion) / (2 * self.config.slack_m**2)
        for _ in range(count):
            steps = self._edges()
            off = ((steps.target_in_source - motion) ** 2).sum(axis=1)
            cost = off / (2 * self.config.slack_m**2)
            carried = self._belief - stay
            np.maximum.at(carried, steps.targets, self._belief[steps.sources] - cost)
            self._belief = np.maximum(carried, self._belief.max() - self.config.leap)
        self._moved_m = np.zeros(3)

    def _edges(self) -> HalfEdges:
        """Edges short enough to be steps, between nodes that the belief covers.

        Of a large map only those of the likeliest nodes: its edges are not in memory.
        """
        if len(self._belief) > self.config.most_nodes:
            best = _core.best_scores(self._belief, self.config.most_carried)
            found = self._graph.half_edges_from(best, self.config.reach_m)
            return found.rows(found.targets < len(self._belief))
        if self._steps is None or self._of_edges != self._graph.edge_count:
            self._steps = self._graph.half_edges(self.config.reach_m)
            self._of_edges = self._graph.edge_count
        known = len(self._belief)
        rows = (self._steps.sources < known) & (self._steps.targets < known)
        return self._steps if rows.all() else self._steps.rows(rows)


# Neighbours in saving order that show the same place: if one does not match, the others mostly do
# not either. Source: nodes are saved every metre, and match up to 3 to 4 m away.
_NEIGHBOURS = 3
# Frames for which a failed node is not tried again, unless nothing else is left.
_PATIENCE = 10


class Relocaliser(Protocol):
    """Proposes nodes to a lost robot."""

    @property
    def name(self) -> str:
        """One of `relocaliser_names()`."""
        ...

    @property
    def new_place(self) -> float | None:
        """Probability that the last frame shows a place outside the map; None if unknown."""
        ...

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """Up to `count` nodes to attempt for this frame, best first.

        Args:
            live: the live frame.
            count: how many attempts the frame's budget allows.
            allowed: whether a node, by its dense index, may be proposed.

        Returns:
            Dense indices into the graph, without repeats.

        Raises:
            IncompatibleError: the frame has another kind of descriptor than the map.
        """
        ...

    def carry_on(self, motion: SE3 | None) -> None:
        """Takes the motion since the last frame, prev_from_curr; None if unknown."""
        ...

    def failed(self, nodes: Sequence[int]) -> None:
        """Takes the nodes, by dense index, whose match with the last frame failed."""
        ...

    def forget(self) -> None:
        """Discards the evidence of earlier frames: the robot was found or carried elsewhere."""
        ...


class Exhaustive:
    """Tries all nodes of the map, over as many live frames as needed.

    Neighbouring nodes show the same place, so the order first covers the map in wide steps and
    then fills the gaps: the bit-reversed count (van der Corput) covers every scale evenly. New
    nodes follow in the next pass.
    """

    name = "exhaustive"
    new_place = None

    def __init__(self, graph: ExperienceGraph, words: NodeWords) -> None:
        del words  # not needed
        self._graph = graph
        self._order: list[int] = []
        self._next = 0

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """See `Relocaliser`; does not use `live`."""
        del live
        if self._next >= len(self._order):
            self._order, self._next = van_der_corput_order(len(self._graph)), 0
        proposed = self._order[self._next : self._next + count]
        self._next += len(proposed)
        return [index for index in proposed if self._graph.holds(index) and allowed(index)]

    def carry_on(self, motion: SE3 | None) -> None:
        """See `Relocaliser`; has no effect."""

    def failed(self, nodes: Sequence[int]) -> None:
        """See `Relocaliser`; has no effect, as each pass tries a node once."""

    def forget(self) -> None:
        """See `Relocaliser`; has no effect: the pass continues."""


class ByAppearance:
    """Proposes nodes that look like the live frames, by a place recogniser (method §6).

    `PlaceBelief` adds up the evidence of several frames, so that a frame that fits many places does
    not decide alone. The attempts of one frame go to different places first, and over several
    frames to less likely ones: a look-alike costs one attempt, not the whole budget.

    Args:
        graph: the experience graph; may grow.
        name: one of `relocaliser_names()`.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        words: NodeWords,
        name: str,
        recogniser: Callable[[Vocabulary], PlaceRecogniser],
    ) -> None:
        self.name = name
        self.book = PlaceBook(graph, words, recogniser)
        self.new_place: float | None = None
        self._belief = PlaceBelief(graph)
        self._frames_seen = 0
        self._tried: dict[int, int] = {}

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """See `Relocaliser`."""
        self.book.learn_new_nodes()
        compared = self.book.compare(self.book.words_of(live))
        self.new_place = compared.new_place
        self._frames_seen += 1
        likely = self._belief.observe(compared.evidence)
        # Recently tried places may all come first.
        most = (_PATIENCE + 2) * count
        places = [place for place in best_places(self.book, likely, most) if allowed(place)]
        fresh = [
            place
            for place in places
            if self._frames_seen - self._tried.get(place, -_PATIENCE) >= _PATIENCE
        ]
        proposed = spread(fresh, count)
        chosen = set(proposed)
        tried = [place for place in places if place not in chosen]
        return proposed + tried[: count - len(proposed)]

    def carry_on(self, motion: SE3 | None) -> None:
        """See `Relocaliser`."""
        self._belief.carry_on(motion)

    def failed(self, nodes: Sequence[int]) -> None:
        """See `Relocaliser`."""
        self._belief.refute(nodes)
        self._tried.update(dict.fromkeys(nodes, self._frames_seen))

    def forget(self) -> None:
        """See `Relocaliser`."""
        self._belief.forget()
        self._tried.clear()


class Suggested:
    """Proposes nodes that something outside the camera suggests, before those of another.

    Suggestions, such as the nodes near a satellite fix, are candidates like any: a match decides.
    They take at most half of a frame's attempts, as the receiver may be wrong.

    Args:
        inner: proposes the other half; None for nothing.
        suggest: nodes for a live frame, by dense index, best first.
    """

    def __init__(
        self, inner: Relocaliser | None, suggest: Callable[[Frame], Sequence[int]]
    ) -> None:
        self.inner = inner
        self.name = "suggested" if inner is None else inner.name
        self._suggest = suggest
        self._frames_seen = 0
        self._tried: dict[int, int] = {}

    @property
    def new_place(self) -> float | None:
        """See `Relocaliser`."""
        return None if self.inner is None else self.inner.new_place

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """See `Relocaliser`."""
        self._frames_seen += 1
        oldest = self._frames_seen - _PATIENCE
        fresh = [
            node
            for node in self._suggest(live)
            if allowed(node) and self._tried.get(node, oldest) <= oldest
        ]
        first = spread(fresh, (count + 1) // 2)
        rest = [] if self.inner is None else self.inner.propose(live, count, allowed)
        return list(dict.fromkeys(first + rest))[:count]

    def carry_on(self, motion: SE3 | None) -> None:
        """See `Relocaliser`."""
        if self.inner is not None:
            self.inner.carry_on(motion)

    def failed(self, nodes: Sequence[int]) -> None:
        """See `Relocaliser`."""
        self._tried.update(dict.fromkeys(nodes, self._frames_seen))
        if self.inner is not None:
            self.inner.failed(nodes)

    def forget(self) -> None:
        """See `Relocaliser`."""
        self._tried.clear()
        if self.inner is not None:
            self.inner.forget()


def best_places(book: PlaceBook, likely: NDArray[np.float64], most: int) -> list[int]:
    """The most likely nodes, best first, without those whose words are unreadable.

    Args:
        likely: (N,) float64, score of each node on any scale.

    Returns:
        Dense indices into the graph.
    """
    best = _core.best_scores(likely, most)
    return [int(place) for place in best if int(place) not in book.unreadable]


def spread(places: list[int], count: int) -> list[int]:
    """The first `count` of `places` in an order that puts neighbours of earlier ones last."""
    apart: list[int] = []
    near: set[int] = set()
    for place in places:
        if len(apart) == count:
            return apart
        if place not in near:
            apart.append(place)
            near.update(range(place - _NEIGHBOURS, place + _NEIGHBOURS + 1))
    chosen = set(apart)
    return (apart + [place for place in places if place not in chosen])[:count]


def van_der_corput_order(count: int) -> list[int]:
    """0 … count−1 in bit-reversed order: every prefix is spread evenly over the range."""
    bits = max(count - 1, 0).bit_length()
    reversed_numbers = (int(f"{i:0{bits}b}"[::-1], 2) if bits else 0 for i in range(1 << bits))
    return [number for number in reversed_numbers if number < count]


def relocaliser_names() -> list[str]:
    """Every way to find a lost robot."""
    return [Exhaustive.name, *recogniser_names()]


def relocaliser_named(name: str) -> Callable[[ExperienceGraph, NodeWords], Relocaliser]:
    """What makes the relocaliser of that name of a map's nodes and their words.

    Raises:
        ConfigError: the name is unknown.
        IncompatibleError: another package adds it, and it cannot be used.
    """
    check_relocaliser(name)
    if name == Exhaustive.name:
        return Exhaustive
    return partial(ByAppearance, name=name, recogniser=recogniser_named(name))


def check_relocaliser(name: str) -> None:
    """Refuses an unknown relocaliser.

    Raises:
        ConfigError: the name is unknown.
    """
    if name == Exhaustive.name or name in RECOGNISERS:
        return  # without a look at what is installed
    if name not in (known := relocaliser_names()):
        raise ConfigError(
            f"relocaliser {name!r} is unknown{where_from(name)}; known: {', '.join(known)}, none"
        )
