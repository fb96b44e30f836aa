"""Closing large loops: each saved node asks once whether the map knows its place (SPEC §5).

Odometry drifts: after a long loop the nodes that truly stand beside the robot may lie outside of
its search radius. So the frame of every saved node is looked up among all places, and the most
likely ones are matched with it. That happens on a thread of its own, off the path of the live
frames, and the answer is taken some frames later, always the same number: what comes of it depends
on the drive alone, not on the speed of the machine.

One match closes no loop: a wrong edge would spoil the map for good, and two streets may show the
same parked cars. It waits until another one, some way on, agrees with it.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError, MapCorruptError
from engram.frontend import Frame
from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, NodeId
from engram.graph.neighbourhood import Search
from engram.localiser import (
    AcceptanceConfig,
    Matcher,
    Position,
    Prediction,
    accept_lost,
    agrees,
    best_places,
    spread,
)
from engram.places.book import PlaceBook

# Places of which those to attempt are chosen, apart from each other.
_SHORTLIST = 256


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Settings of `LoopSearch`.

    Attributes:
        attempts: places matched with each saved node. Off the frames' path there is time for more
            than a live frame has.
        answer_after_frames: live frames after which an answer is taken. A query and its attempts
            take a few milliseconds: at 20 frames a second it is there long before.
        near_m: nodes within this distance are candidates of the localiser anyway. Source: SPEC §3,
            the search radius.
        own_exclusion_m: own nodes saved within the last so many metres close no loop. Source:
            SPEC §3.1.
        confirm_after_m: two matches confirm each other when they were made at least this far apart,
            or, where the first one saw what is farther away, as far as that. What stands beside one
            of them is then out of the other's sight: half of all landmarks of a street are within
            10 m, but two corner houses of a kind may be seen alike from 30 m away on.
        confirm_after_most_m: as far apart at most.
        confirm_within_m: a match that nothing confirmed so far past this is dropped.
        certain_m: standard deviation past which the chains between two matches confirm nothing.
    """

    attempts: int = 8
    answer_after_frames: int = 5
    near_m: float = 8.0
    own_exclusion_m: float = 30.0
    confirm_after_m: float = 8.0
    confirm_after_most_m: float = 20.0
    confirm_within_m: float = 22.0
    certain_m: float = 1.0

    def __post_init__(self) -> None:
        for name in ("attempts", "answer_after_frames"):
            if getattr(self, name) < 1:
                raise ConfigError(f"loops: {name} is {getattr(self, name)}, must be >= 1")
        for name in (
            "near_m", "own_exclusion_m", "confirm_after_m", "confirm_after_most_m",
            "confirm_within_m", "certain_m",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"loops: {name} is {getattr(self, name)}, must be >= 0")


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """A saved node, its frame, and (N,) bool: which nodes would be news."""

    node: NodeId
    frame: Frame
    news: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """An edge that would close a loop, its inliers, and how far away what they saw is."""

    edge: Edge
    inliers: int
    depth_m: float


class LoopSearch:
    """Looks for the places of saved nodes, on a thread of its own. A context manager.

    Args:
        graph: the experience graph; searched by the calling thread only.
        book: the words of its nodes.
        matcher: the first half of an attempt.
        acceptance: the second half, as for a lost robot: no prediction speaks for a match.
        config: settings.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        book: PlaceBook,
        matcher: Matcher,
        acceptance: AcceptanceConfig,
        config: LoopConfig | None = None,
    ) -> None:
        self.config = config or LoopConfig()
        self._graph = graph
        self._book = book
        self._matcher = matcher
        self._acceptance = acceptance
        self._frames = 0
        self._asked: deque[tuple[int, Future[_Match | None]]] = deque()
        self._waiting: list[_Match] = []
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="engram-loops")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the thread; questions that nobody waits for any more are dropped."""
        self._thread.shutdown(cancel_futures=True)

    def ask(self, node: Node, frame: Frame) -> None:
        """Looks up a node that was just saved and added to the graph; returns at once."""
        self._book.learn_new_nodes()
        question = _Question(node.id, frame, self._news(node))
        self._asked.append((self._frames, self._thread.submit(self._answer, question)))

    def closed(self) -> list[Edge]:
        """The loops that are closed by now, each from the known node to the new one.

        Call it once per live frame.
        """
        self._frames += 1
        return self._answers_to(self._frames - self.config.answer_after_frames)

    def finish(self) -> list[Edge]:
        """Waits for all answers."""
        return self._answers_to(self._frames)

    def _answers_to(self, frame: int) -> list[Edge]:
        edges = []
        while self._asked and self._asked[0][0] <= frame:
            match = self._asked.popleft()[1].result()
            if match is not None:
                edges += [one.edge for one in self._confirmed(match)]
        return edges

    def _confirmed(self, match: _Match) -> list[_Match]:
        """The match and those that waited for it; or none, and it waits itself."""
        here_m, within_m = self._driven_m(match.edge), self.config.confirm_within_m
        passed_m = {one: here_m - self._driven_m(one.edge) for one in self._waiting}
        self._waiting = [
            one for one, m in passed_m.items() if m <= self._base_line_m(one) + within_m
        ]
        agreeing = [
            one
            for one in self._waiting
            if passed_m[one] >= self._base_line_m(one) and self._agree(one.edge, match.edge)
        ]
        if not agreeing:
            self._waiting.append(match)
            return []
        self._waiting = [one for one in self._waiting if one not in agreeing]
        return [*agreeing, match]

    def _base_line_m(self, match: _Match) -> float:
        """How far on another match must be that confirms it."""
        least_m, most_m = self.config.confirm_after_m, self.config.confirm_after_most_m
        return max(least_m, min(match.depth_m, most_m))

    def _driven_m(self, edge: Edge) -> float:
        """How far the robot had come when it saved the new node."""
        return float(self._graph.driven_m[self._graph.index(edge.b)])

    def _agree(self, first: Edge, second: Edge) -> bool:
        """Whether two matches put the robot where it drove from one to the other."""
        graph = self._graph
        driven = graph.predict(graph.index(first.b), graph.index(second.b))
        known = graph.predict(graph.index(first.a), graph.index(second.a))
        if driven is None or known is None:
            return False
        carried = Position(first.a, first.a_from_b, first.covariance).carried_on(*driven)
        covariance = carried.covariance + known[1]
        sigma_m = Position(first.a, carried.node_from_live, covariance).sigma_m
        sigma_yaw_rad = float(np.sqrt(covariance[4, 4]))
        prediction = Prediction(carried.node_from_live, sigma_m, sigma_yaw_rad)
        # Places that a long chain joins would agree with anything.
        certain = sigma_m <= self.config.certain_m
        return certain and agrees(known[0] @ second.a_from_b, prediction, self._acceptance)

    def _news(self, node: Node) -> NDArray[np.bool_]:
        """Nodes that are neither near the node, by all that is known, nor just saved."""
        graph = self._graph
        index = graph.index(node.id)
        own = graph.sessions == graph.sessions[index]
        recent = graph.driven_m > node.driven_m - self.config.own_exclusion_m
        news: NDArray[np.bool_] = ~(own & recent)
        near = graph.neighbourhood(
            index,
            SE3.identity(),
            np.zeros((6, 6)),
            Search(self.config.near_m, np.pi),
        )
        news[near.nodes] = False
        return news

    def _answer(self, question: _Question) -> _Match | None:
        """The best match among the most likely places; None if none is believed."""
        if not question.news.any():
            return None
        compared = self._book.compare(self._book.words_of(question.frame))
        evidence = compared.evidence[: len(question.news)]
        likely = np.where(question.news, evidence, -np.inf)
        likeliest = best_places(self._book, likely, _SHORTLIST)
        places = [place for place in likeliest if question.news[place]]
        matches = [self._matched(question, place) for place in spread(places, self.config.attempts)]
        believed = [found for found in matches if found is not None]
        return max(believed, key=lambda found: found.inliers, default=None)

    def _matched(self, question: _Question, place: int) -> _Match | None:
        """The match with a place, if it is believed."""
        known = self._graph.node(place).id
        try:
            match = self._matcher.match(question.frame, question.node, known, None)
        except MapCorruptError:
            self._book.unreadable.add(place)  # not to be proposed again; `engram check` names it
            return None
        if match.reference_from_live is None or match.covariance is None:
            return None
        over = cache(partial(self._matcher.spread, question.frame, question.node, known, match))
        if not accept_lost(match, over, self._acceptance):
            return None
        edge = Edge(
            known, question.node, EdgeKind.MATCH, match.reference_from_live, match.covariance
        )
        return _Match(edge, match.inliers, over().depth_m)
