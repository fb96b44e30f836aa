"""Maps for evaluations: what is refused while they are built, and where drives start in them."""

from pathlib import Path

import numpy as np
import pytest
from tests.evaluation.campaigns import few_options, write_campaign

from engram.drive import MapOptions, Settings, open_map
from engram.evaluation import DriveSet
from engram.evaluation.building import build_map, true_nodes
from engram.evaluation.configurations import EVERYTHING, UNLIMITED, sweep
from engram.evaluation.starting import TrueNodes
from engram.experience.graph import ExperienceGraph
from engram.experience.model import EdgeKind
from engram.geometry import SE3
from engram.sequences.trajectories import Trajectory, read_truth, write_tum

OPTIONS: MapOptions = few_options().build


@pytest.fixture
def campaign(tmp_path: Path) -> DriveSet:
    return write_campaign(tmp_path / "campaign", (0, 0))


def edges(path: Path, drives: DriveSet) -> list[tuple[EdgeKind, float]]:
    """Kind of each edge, and how far it is from the truth."""
    with open_map(path) as opened:
        nodes = true_nodes(opened, drives.drives)
        found = []
        for edge in opened.graph.edges:
            a, b = nodes.pose(edge.a), nodes.pose(edge.b)
            assert a is not None
            assert b is not None
            error = np.linalg.norm((a.inverse() @ b).translation - edge.a_from_b.translation)
            found.append((edge.kind, float(error)))
        return found


def test_right_matches_are_kept(campaign: DriveSet, tmp_path: Path) -> None:
    built = build_map(tmp_path / "town.engram", campaign.drives, Settings(), OPTIONS)
    assert built.sessions[1].refused == 0
    assert built.sessions[1].share_localised > 0.9


def test_matches_that_truth_contradicts_are_refused_and_make_no_edges(
    tmp_path: Path,
) -> None:
    # The second drive says that it is 5 m further along than what it sees.
    campaign = write_campaign(tmp_path / "campaign", (0, 0))
    path = campaign.drives[1].path.with_suffix(".truth.txt")
    known = read_truth(campaign.drives[1].path)
    assert known is not None
    ahead = SE3(np.eye(3), np.array([0.0, 0.0, 5.0]))
    write_tum(path, Trajectory(known.stamps_ns, [pose @ ahead for pose in known.world_from_cam]))
    built = build_map(tmp_path / "town.engram", campaign.drives, Settings(), OPTIONS)
    assert built.sessions[1].refused > 0
    assert built.sessions[1].share_localised == 0
    kinds = [kind for kind, _ in edges(tmp_path / "town.engram", campaign)]
    assert EdgeKind.MATCH not in kinds


class FakeMap:
    """Nodes of a real map, some of them cut off from the rest."""

    def __init__(self, graph: ExperienceGraph, cut_off: int) -> None:
        self.graph = self
        self.nodes = graph.nodes
        self._graph = graph
        self._cut_off = cut_off

    def index(self, node) -> int:
        return self._graph.index(node)

    def components(self) -> np.ndarray:
        return (np.arange(len(self.nodes)) == self._cut_off).astype(np.int32)


def test_a_drive_starts_where_the_map_hangs_together(campaign: DriveSet, tmp_path: Path) -> None:
    build_map(tmp_path / "town.engram", campaign.drives, Settings(), OPTIONS)
    truths = {one.session.id: one.truth() for one in campaign.drives}
    with open_map(tmp_path / "town.engram") as opened:
        nodes = true_nodes(opened, campaign.drives)
        alone = opened.graph.nodes[4].id
        there = nodes.pose(alone)
        assert there is not None
        plain = nodes.start(there)
        cut = TrueNodes(FakeMap(opened.graph, 4), truths).start(there)
    assert plain is not None
    assert plain.node == alone
    assert cut is not None
    assert cut.node != alone
    # The same place, seen from another node.
    pose = nodes.pose(cut.node)
    assert pose is not None
    np.testing.assert_allclose((pose @ cut.node_from_live).translation, there.translation)


def test_every_candidate_is_attempted_only_where_something_asks_for_it() -> None:
    assert EVERYTHING not in sweep(("distance", "path"), (1, 2), (1,))
    assert EVERYTHING in sweep(("distance", "oracle"), (1, 2), (1,))
    assert EVERYTHING in sweep(("path",), (2, UNLIMITED), (1,))
