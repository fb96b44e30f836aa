"""Maps for evaluations, and where drives start in them."""

from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import few_options, write_campaign

from engram.graph.graph import ExperienceGraph
from engram.maps.map import open_map
from engram.robot.settings import RobotOptions, Settings
from engram_lab.studies.building import build_map, true_nodes
from engram_lab.studies.configurations import EVERYTHING, UNLIMITED, sweep
from engram_lab.studies.drives import DriveSet, TrueNodes

OPTIONS: RobotOptions = few_options().build


@pytest.fixture
def campaign(tmp_path: Path) -> DriveSet:
    return write_campaign(tmp_path / "campaign", (0, 0))


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
    assert EVERYTHING not in sweep(("distance", "path-near"), (1, 2), (1,))
    assert EVERYTHING in sweep(("distance", "oracle"), (1, 2), (1,))
    assert EVERYTHING in sweep(("path-near",), (2, UNLIMITED), (1,))
