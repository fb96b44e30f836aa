"""Closing large loops: each saved node is looked up once among all places (method §5).

Odometry drifts: after a long loop the nodes next to the robot may lie outside its search radius.
So place recognition looks up the frame of every saved node, and the most likely places are matched
with it. This runs on its own thread. The result is used a fixed number of frames later, so that it
depends on the drive alone, not on the speed of the machine.

One match closes no loop: a wrong edge would damage the map permanently, and two streets may show
the same parked cars. A match waits until another one, farther along, agrees with it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.frontend.frame import Frame
from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, NodeId
from engram.graph.neighbourhood import Search
from engram.localiser.acceptance import AcceptanceConfig, Prediction, agrees
from engram.localiser.attempts import Attempter, Candidate
from engram.localiser.localisation import Position
from engram.localiser.relocalisation import best_places, spread
from engram.localiser.yardstick import ALIKE, Likeness, Yardstick, is_measured
from engram.places.words import PlaceBook

# Most likely places, from which those to attempt are chosen apart from each other.
_SHORTLIST = 256


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Settings of `LoopSearch`.

    Attributes:
        attempts: places matched with each saved node; more than a live frame has time for.
        answer_after_frames: live frames after which a result is used. A lookup takes a few
            milliseconds, far less than this many frames.
        near_m: nodes within this distance are candidates of the localiser anyway, metres. Source:
            the search radius, method §3.
        own_exclusion_m: own nodes saved within this last distance close no loop, metres. Source:
            method §3.1.
        confirm_after_m: least distance between two matches that confirm each other, metres; the
            depth of the first one's inliers if that is larger. The scene of one match is then out
            of sight of the other.
        confirm_after_most_m: upper limit of that distance, metres.
        confirm_within_m: distance beyond it after which an unconfirmed match is dropped, metres.
        certain_m: largest standard deviation of the path between two matches that confirm each
            other, metres.
        proof: mean log-odds that two matches are no look-alikes, from which they confirm each
            other. Source: `lab/reports/lookalikes.md`.
        own_share: share of the usual inliers that two matches with nodes of the same drive must
            have in the geometric mean: within minutes neither light nor season excuses fewer.
            Source: as `proof`.
    """

    attempts: int = 8
    answer_after_frames: int = 5
    near_m: float = 8.0
    own_exclusion_m: float = 30.0
    confirm_after_m: float = 8.0
    confirm_after_most_m: float = 20.0
    confirm_within_m: float = 22.0
    certain_m: float = 1.0
    proof: float = 2.0
    own_share: float = 0.6

    def __post_init__(self) -> None:
        for name in ("attempts", "answer_after_frames"):
            if getattr(self, name) < 1:
                raise ConfigError(f"loops: {name} is {getattr(self, name)}, must be >= 1")
        for name in (
            "near_m", "own_exclusion_m", "confirm_after_m", "confirm_after_most_m",
            "confirm_within_m", "certain_m", "proof",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"loops: {name} is {getattr(self, name)}, must be >= 0")
        if not 0 < self.own_share < np.inf:
            raise ConfigError(f"loops: own_share is {self.own_share}, must be > 0")


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """A saved node that may close a loop.

    Attributes:
        frame: its frame.
        known: nodes of the map when it was saved.
        excluded: (K,) int64, dense indices of those that would close no loop, each once.
    """

    node: NodeId
    frame: Frame
    known: int
    excluded: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """A match that would close a loop.

    Attributes:
        alike: log-odds that it is a look-alike, beyond those that prove it none.
    """

    edge: Edge
    match: Match
    frame: Frame
    depth_m: float
    alike: float = 0.0


class LoopSearch:
    """Finds loops at saved nodes, on its own thread. A context manager.

    Args:
        graph: the experience graph; searched by the calling thread only.
        attempter: makes attempts, as of a lost robot: there is no prediction.
        yardstick: what matches in this map usually have; None: look-alikes are not detected.
        saved: the drive's nodes that an interrupted run had saved.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        book: PlaceBook,
        attempter: Attempter,
        acceptance: AcceptanceConfig,
        config: LoopConfig | None = None,
        yardstick: Yardstick | None = None,
        saved: Sequence[Node] = (),
    ) -> None:
        self.config = config or LoopConfig()
        self._graph = graph
        self._book = book
        self._attempter = attempter
        self._acceptance = acceptance
        self._yardstick = yardstick
        self._frames = 0
        self._asked: deque[tuple[int, Future[_Match | None]]] = deque()
        self._waiting: list[_Match] = []
        # Own nodes within `own_exclusion_m`, by dense index, with the distance driven.
        self._recent: deque[tuple[int, float]] = deque()
        for node in reversed(saved):
            if node.driven_m <= saved[-1].driven_m - self.config.own_exclusion_m:
                break
            self._recent.appendleft((graph.index(node.id), node.driven_m))
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="engram-loops")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the thread and drops pending lookups."""
        self._thread.shutdown(cancel_futures=True)

    def ask(self, node: Node, frame: Frame) -> None:
        """Starts the lookup of a node that was just saved and added to the graph."""
        self._book.learn_new_nodes()
        question = _Question(node.id, frame, len(self._graph), self._excluded(node))
        self._asked.append((self._frames, self._thread.submit(self._answer, question)))

    def closed(self) -> list[Edge]:
        """Edges of newly closed loops, each from the known node to the new one.

        Call it once per live frame.
        """
        self._frames += 1
        return self._answers_to(self._frames - self.config.answer_after_frames)

    def finish(self) -> list[Edge]:
        """Waits for all lookups; returns the edges of the loops that they close."""
        return self._answers_to(self._frames)

    def _answers_to(self, frame: int) -> list[Edge]:
        edges = []
        while self._asked and self._asked[0][0] <= frame:
            match = self._asked.popleft()[1].result()
            if match is not None:
                edges += [one.edge for one in self._confirmed(self._weighed(match))]
        return edges

    def _weighed(self, found: _Match) -> _Match:
        """The match with the log-odds that it is a look-alike."""
        graph, edge = self._graph, found.edge
        index = graph.index(edge.a)
        usual = None if self._yardstick is None else self._yardstick.usual(index)
        known = self._attempter.frame(found.edge.a)
        if usual is None or known is None or not is_measured(known.descriptor):
            return found
        likeness = Likeness.of(found.match, known, found.frame, usual)
        alike = likeness.alike() + self.config.proof
        if graph.node(index).session == graph.node(graph.index(edge.b)).session:
            missing = math.log(self.config.own_share) - likeness.share
            alike = max(alike, -ALIKE.share * missing)
        return replace(found, alike=alike)

    def _confirmed(self, match: _Match) -> list[_Match]:
        """The match and the waiting ones that agree with it; none if it must wait itself."""
        here_m, within_m = self._driven_m(match.edge), self.config.confirm_within_m
        passed_m = {
            hypothesis: here_m - self._driven_m(hypothesis.edge) for hypothesis in self._waiting
        }
        self._waiting = [
            one for one, m in passed_m.items() if m <= self._base_line_m(one) + within_m
        ]
        agreeing = [
            hypothesis
            for hypothesis in self._waiting
            if passed_m[hypothesis] >= self._base_line_m(hypothesis)
            and hypothesis.alike + match.alike <= 0
            and edges_agree(
                self._graph, hypothesis.edge, match.edge, self._acceptance, self.config.certain_m
            )
        ]
        if not agreeing:
            self._waiting.append(match)
            return []
        self._waiting = [hypothesis for hypothesis in self._waiting if hypothesis not in agreeing]
        return [*agreeing, match]

    def _base_line_m(self, match: _Match) -> float:
        """Least distance to another match that confirms this one."""
        least_m, most_m = self.config.confirm_after_m, self.config.confirm_after_most_m
        return max(least_m, min(match.depth_m, most_m))

    def _driven_m(self, edge: Edge) -> float:
        """Distance driven when the robot saved the new node."""
        return self._graph.node(self._graph.index(edge.b)).driven_m

    def _excluded(self, node: Node) -> NDArray[np.int64]:
        """(K,) int64: nodes known to be near this node, or just saved."""
        index = self._graph.index(node.id)
        near = self._graph.neighbourhood(
            index, SE3.identity(), np.zeros((6, 6)), Search(self.config.near_m, np.pi)
        )
        self._recent.append((index, node.driven_m))
        while self._recent and self._recent[0][1] <= node.driven_m - self.config.own_exclusion_m:
            self._recent.popleft()
        just_saved = np.array([own for own, _ in self._recent], np.int64)
        return np.unique(np.concatenate([just_saved, near.nodes.astype(np.int64)]))

    def _answer(self, question: _Question) -> _Match | None:
        """The best accepted match among the most likely places."""
        if len(question.excluded) == question.known:
            return None
        compared = self._book.compare(self._book.words_of(question.frame))
        likely = compared.evidence[: question.known].copy()
        likely[question.excluded] = -np.inf
        excluded = set(question.excluded.tolist())
        likeliest = best_places(self._book, likely, _SHORTLIST)
        places = [place for place in likeliest if place not in excluded]
        matches = [self._matched(question, place) for place in spread(places, self.config.attempts)]
        believed = [found for found in matches if found is not None]
        return max(believed, key=lambda found: found.match.inliers, default=None)

    def _matched(self, question: _Question, place: int) -> _Match | None:
        """The match with a place, if it is accepted."""
        # Its record is for the thread of the graph alone.
        known = next(self._graph.ids(place, place + 1))
        if known is None:
            return None
        candidate = Candidate(place, known, None, guided=False, row=None)
        outcome = self._attempter.attempt(question.frame, question.node, 0, candidate)
        if outcome.damaged:
            self._book.unreadable.add(place)  # not to be proposed again; `engram check` names it
        match, evidence = outcome.match, outcome.evidence
        if not outcome.accepted or evidence is None or evidence.spread is None:
            return None
        assert match.reference_from_live is not None
        assert match.covariance is not None
        edge = Edge(
            known, question.node, EdgeKind.MATCH, match.reference_from_live, match.covariance
        )
        return _Match(edge, match, question.frame, evidence.spread.depth_m)


def edges_agree(
    graph: ExperienceGraph,
    first: Edge,
    second: Edge,
    acceptance: AcceptanceConfig,
    certain_m: float,
) -> bool:
    """Whether the ways on both sides of two edges agree with what they say.

    Args:
        graph: contains the paths from `a` to `a`, and from `b` to `b`.
        first, second: edges between the same two parts of it.
        certain_m: largest standard deviation of both ways; a long chain contradicts nothing.
    """
    driven = graph.predict(graph.index(first.b), graph.index(second.b))
    known = graph.predict(graph.index(first.a), graph.index(second.a))
    if driven is None or known is None:
        return False
    carried = Position(first.a, first.a_from_b, first.covariance).carried_on(*driven)
    covariance = carried.covariance + known[1]
    sigma_m = Position(first.a, carried.node_from_live, covariance).sigma_m
    sigma_yaw_rad = float(np.sqrt(covariance[4, 4]))
    prediction = Prediction(carried.node_from_live, sigma_m, sigma_yaw_rad)
    certain = sigma_m <= certain_m
    return certain and agrees(known[0] @ second.a_from_b, prediction, acceptance)
