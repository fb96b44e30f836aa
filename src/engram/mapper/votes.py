"""Edges that live fixes contradict again and again: distrusted at once, removed with the session.

Two nodes that one live frame matches surely are measured relative to each other. Where the map says
otherwise, one of the edges between them joins what does not belong together. Each such frame votes
against the edges of that chain which matching made; frames that agree vote for theirs. Odometry's
own steps are not accused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec import Meta

from engram.config import check_bounds
from engram.graph.graph import ChainTree, ExperienceGraph
from engram.graph.marks import Removal
from engram.graph.model import Edge, EdgeKind
from engram.localiser import Position
from engram.localiser.attempts import Outcome
from engram.mapper.edges import edge_through_live

# Of a distrusted edge: nothing is predicted through it any more.
_NOWHERE = np.diag([1e3**2] * 3 + [np.pi**2] * 3)


@dataclass(frozen=True, slots=True)
class VoteConfig:
    """Settings of `EdgeVotes`.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    against: Annotated[
        int,
        Meta(ge=1, description="frames that contradict an edge before it is distrusted, plus "
             "twice the frames that agree with it"),
    ] = 4  # fmt: skip
    inliers: Annotated[
        int,
        Meta(ge=0, description="fewest inliers of both matches of a vote; look-alikes reach 50"),
    ] = 60
    gross_m: Annotated[
        float, Meta(ge=0, description="least disagreement that is a contradiction, m")
    ] = 2.0
    sigmas: Annotated[
        float, Meta(ge=0, description="the same in standard deviations of the chain")
    ] = 4.0

    def __post_init__(self) -> None:
        check_bounds(self)


class EdgeVotes:
    """Votes of the frames of one drive.

    Args:
        graph: the experience graph of the drive alone: distrusted edges are changed in it.
        config: settings.

    Attributes:
        removals: the distrusted edges, to be stored with the drive.
    """

    def __init__(self, graph: ExperienceGraph, config: VoteConfig | None = None) -> None:
        self.config = config or VoteConfig()
        self.removals: list[Removal] = []
        self._graph = graph
        self._against: Counter[int] = Counter()
        self._agreeing: Counter[int] = Counter()

    def count(self, stamp_ns: int, outcomes: Sequence[Outcome]) -> None:
        """Counts the votes of one localised frame, and distrusts what was contradicted too often.

        Args:
            stamp_ns: stamp of the frame.
            outcomes: of its attempts.
        """
        sure = sorted(self._sure(outcomes), key=lambda found: found[0], reverse=True)
        if len(sure) < 2:
            return
        best = sure[0][1]
        measured = [edge_through_live(best, other, EdgeKind.MATCH) for _, other in sure[1:]]
        goals = [self._graph.index(edge.b) for edge in measured]
        tree = self._graph.chains_from(self._graph.index(best.node), goals=goals)
        against, agreeing = set[int](), set[int]()
        for edge, goal in zip(measured, goals, strict=True):
            if goal in tree.row_of and edge.a != edge.b:
                chain = set(self._chain(tree, goal))
                (against if self._contradicts(edge, tree, goal) else agreeing).update(chain)
        self._agreeing.update(agreeing)
        self._against.update(against - agreeing)
        for row in sorted(against - agreeing):
            most = max(self.config.against, 2 * self._agreeing[row])
            if self._against[row] >= most:
                self._distrust(row, stamp_ns)

    def _sure(self, outcomes: Sequence[Outcome]) -> Iterator[tuple[int, Position]]:
        for one in outcomes:
            pose, covariance = one.match.reference_from_live, one.match.covariance
            if pose is None or covariance is None or one.match.inliers < self.config.inliers:
                continue
            yield one.match.inliers, Position(one.candidate.node, pose, covariance)

    def _contradicts(self, edge: Edge, tree: ChainTree, goal: int) -> bool:
        pose = tree.pose(goal)
        covariance = tree.error(goal).pivoted(pose.translation).covariance() + edge.covariance
        sigma_m = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))
        off_m = float(np.linalg.norm(pose.translation - edge.a_from_b.translation))
        return off_m > max(self.config.gross_m, self.config.sigmas * sigma_m)

    def _chain(self, tree: ChainTree, goal: int) -> Iterator[int]:
        """Edges that matching made, on the path from the tree's root to a node."""
        row = tree.row_of[goal]
        while (half := int(tree.half_edges[row])) >= 0:
            if self._graph.edges[half // 2].kind is not EdgeKind.ODOMETRY:
                yield half // 2
            row = int(tree.parents[row])

    def _distrust(self, row: int, stamp_ns: int) -> None:
        edge, count = self._graph.edges[row], self._against.pop(row)
        self._graph.add_edge(replace(edge, covariance=_NOWHERE))
        reason = f"{count} frames of a drive that matched nodes on both sides contradict it"
        self.removals.append(
            Removal(edge.a, edge.b, edge.kind, edge.a_from_b, reason, removed_ns=stamp_ns)
        )
