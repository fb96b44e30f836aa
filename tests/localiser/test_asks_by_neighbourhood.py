"""The localising loop asks a map by neighbourhood and by id: nothing enumerates it.

A map may be larger than memory: a loop that touches every node, edge or path could not run on one
that is read page by page. What still looks at the whole map, and when:

* opening a map for ranking: the counts of match basins, over all attempts;
* a lost robot: place recognition compares with every node, `PlaceBelief` spreads over all edges;
* a mapper: it takes the whole graph;
* the centre and pictures: components, regions, lay-out, downloads, differences and checks.
"""

from pathlib import Path

import pytest
from tests.builders import TOWN, TOWN_ROAD, drive, localised

from engram.graph.pages import PagedGraph
from engram.graph.paths import PathMemory
from engram.localiser.localisation import Position
from engram.maps.map import Map
from engram.ranking.policies import POLICIES
from engram.robot.localisers import localiser_in
from engram.robot.settings import Settings


class EnumeratedError(AssertionError):
    """Somebody asked for all of a map."""


def _refuse(name: str) -> property:
    def asked(_self: object) -> None:
        raise EnumeratedError(f"{name}: the loop must ask by neighbourhood or id")

    return property(asked)


class AskedGraph(PagedGraph):
    """A graph that answers questions about nodes and their surroundings only."""

    nodes = _refuse("nodes")
    edges = _refuse("edges")
    edge_ends = _refuse("edge_ends")
    sessions = _refuse("sessions")
    driven_m = _refuse("driven_m")
    experiences = _refuse("experiences")
    components = _refuse("components")
    half_edges = _refuse("half_edges")
    lightest = _refuse("lightest")


class AskedPaths(PathMemory):
    """A path memory that does not say which paths there are."""

    paths = _refuse("paths")


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_the_localising_loop_enumerates_nothing(town: Path, policy: str) -> None:
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)
    with (
        Map.open(town) as opened,
        localiser_in(
            opened, live[0].frame.camera, Settings(), policy=policy, relocaliser=None
        ) as localiser,
    ):
        localiser.place_at(Position.at(localiser.graph.node(0).id))
        localiser.graph.__class__, localiser._paths.__class__ = AskedGraph, AskedPaths
        found = localised(localiser, live)
        assert opened._contents is None, "the whole map was read"
    assert all(one.node is not None for one in found)


def test_the_doubles_do_refuse(town: Path) -> None:
    with Map.open(town) as opened:
        graph = opened.read_graph()
        paths = PathMemory(graph, pages=opened.pages)
        graph.__class__, paths.__class__ = AskedGraph, AskedPaths
        for asks in (
            lambda: graph.nodes,
            lambda: graph.components,
            lambda: graph.edges,
            lambda: graph.half_edges(2.0),
            lambda: paths.paths,
        ):
            with pytest.raises(EnumeratedError):
                asks()
