"""Lays out a map in its frame: for readers, and for what a revision writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from engram.graph.graph import ExperienceGraph
from engram.graph.marks import Placement
from engram.graph.model import Edge, Node
from engram.graph.placing import PlacingConfig, place, replace_after_removal
from engram.maps.map_frame import MapFrame, changed

if TYPE_CHECKING:
    from engram.maps.map_reader import MapReader

# Name of the statistic that holds latitude and longitude of the frame's origin.
ORIGIN = "map_frame"


def frame_of(store: MapReader, revision: int, nodes: int) -> MapFrame:
    """The map frame of an opened map; `MapReader.frame` shares it.

    Args:
        store: the map.
        revision, nodes: of the map, for `MapReader.derived`: the frame changes with them.
    """
    del revision, nodes
    graph = store.graph
    origin = store.statistics().get(ORIGIN)
    known = None if not origin else (origin["latitude_deg"], origin["longitude_deg"])
    return MapFrame(graph, place(graph, store.placements), known)


def new_places(
    store: MapReader, contents: Mapping[str, float], config: PlacingConfig
) -> list[Placement]:
    """The places that an open revision has to write, around those that nodes have.

    Args:
        store: the map, which sees the rows of the revision.
        contents: number of rows that the revision wrote, by table.
        config: how new nodes are laid out.
    """
    graph = store.grown_graph() if not contents["removals"] else None
    if graph is None:
        found = store.load()
        graph = graph_of(found.nodes, found.edges)
    own = contents["placements"] or contents["hidden"]
    before = store.read_placements() if own else store.placements
    lay_out = replace_after_removal if contents["removals"] else place
    return changed(before, graph, lay_out(graph, before, config), config.same_m)


def graph_of(nodes: Sequence[Node], edges: Sequence[Edge]) -> ExperienceGraph:
    """A graph of these records."""
    graph = ExperienceGraph()
    graph.add_nodes(nodes)
    graph.add_edges(edges)
    return graph
