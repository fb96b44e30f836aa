"""Maps without false matches, for evaluations of what comes after (SPEC §8)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from engram.drive import OpenMap
from engram.evaluation.drives import EvaluatedDrive
from engram.experience.graph import ExperienceGraph
from engram.experience.model import NodeId
from engram.frontend import Frame
from engram.frontend.matching import Match
from engram.geometry import SE3
from engram.localiser import Matcher, Prediction, Spread
from engram.measures.accuracy import FALSE_BEYOND_M, FALSE_BEYOND_RAD

_NO_ROWS = np.empty(0, dtype=np.int32)
_NO_MATCH = Match(None, None, 0, _NO_ROWS, _NO_ROWS)


class Vetting:
    """Refuses what truth says is a false match while a drive is being mapped.

    Streets of a made-up town look alike: in `village` 12 of the 16 loops that the first drive
    closed were wrong, and with them nine tenths of the edges that followed. Such a map would hide
    whatever the policies do in it. Held-out drives get no such help.

    Args:
        drive: the drive that is mapped.
        drives: all that the map is built from; matches with nodes of others, or of drives without
            truth, are let through.

    Attributes:
        refused: stamps of live frames and nodes of the matches refused.
    """

    def __init__(self, drive: EvaluatedDrive, drives: Sequence[EvaluatedDrive]) -> None:
        self._drive = drive.truth()
        self._truths = {one.session.id: one.truth() for one in drives}
        self.refused: set[tuple[int, NodeId]] = set()

    def matcher(self, opened: OpenMap, matcher: Matcher) -> Matcher:
        """Puts itself before a map's matcher."""
        return _Vetted(matcher, opened.graph, self)

    def is_false(self, graph: ExperienceGraph, node: NodeId, live: Frame, found: SE3) -> bool:
        """Whether ``node_from_live`` is further from the truth than a success may be."""
        known = graph.node(graph.index(node))
        truth = self._truths.get(known.session)
        world_from_node = None if truth is None else truth.at(known.stamp_ns)
        world_from_live = None if self._drive is None else self._drive.at(live.stamp_ns)
        if world_from_node is None or world_from_live is None:
            return False
        error = (world_from_node.inverse() @ world_from_live).inverse() @ found
        return error.distance_m > FALSE_BEYOND_M or error.angle_rad > FALSE_BEYOND_RAD


class _Vetted:
    def __init__(self, matcher: Matcher, graph: ExperienceGraph, vetting: Vetting) -> None:
        self._matcher = matcher
        self._graph = graph
        self._vetting = vetting

    @property
    def threads(self) -> bool:
        """See `Matcher`."""
        return self._matcher.threads

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        """See `Matcher`."""
        match = self._matcher.match(live, live_id, node, guide)
        found = match.reference_from_live
        if found is None or not self._vetting.is_false(self._graph, node, live, found):
            return match
        self._vetting.refused.add((live.stamp_ns, node))
        return _NO_MATCH

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        """See `Matcher`."""
        return self._matcher.spread(live, live_id, node, match)

    def prefetch(self, nodes: list[NodeId]) -> None:
        """See `Matcher`."""
        self._matcher.prefetch(nodes)
