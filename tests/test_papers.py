"""The papers' settings: each rule in the page's table is what its file says, and departs or not."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.fleet.robots import OPTIONS, merged, robot_map
from tests.fleet.test_updating import Content
from tests.mapping_rig import localised, map_simulated
from tests.synthetic_world import World, drive
from tests.worlds import covariance_of, forward, make_edge, make_node

from engram.cli.settings import every_setting, read_settings
from engram.fleet.merge import MergeOptions, Reason
from engram.fleet.merge.whole_segments import SeedFrom, Unit
from engram.geometry import SE3
from engram.graph.breadth_first import breadth_first
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind, PathEntry, PathEntryKind, path_id
from engram.graph.neighbourhood import Search
from engram.graph.paths import MATCHES_ONLY, PathMemory
from engram.localiser import Budget, LocaliserConfig, Position
from engram.localiser.settings import NeighbourhoodSearch, PathEntries, Success
from engram.maps import Map
from engram.ranking import POLICIES
from engram.robot import Settings, load_settings
from engram.robot.localisers import localiser_in
from engram.robot.settings import PAPERS

PAGE = Path(__file__).parents[1] / "docs" / "papers.md"
WORLD = World(30.0)
ROAD = np.arange(0.0, 25.0, 0.7)


def rows() -> list[tuple[str, str, str, str]]:
    """Paper, key, its value and our default of each rule on the page that a setting gives."""
    found = []
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        given = re.fullmatch(r"`([\w.]+) = (.+)`", cells[1]) if len(cells) == 4 else None
        if given is not None:
            paper = "gadd2016" if cells[0].startswith("[G16]") else "linegar2015"
            found.append((paper, given[1], given[2], cells[2].strip("`")))
    assert len(found) >= 20
    return found


def shown(settings, key: str) -> str:
    (one,) = [one for one in every_setting(settings) if one.key == key]
    return str(one.value)


@pytest.mark.parametrize(("paper", "key", "value", "default"), rows())
def test_each_rule_of_the_page_is_what_its_file_sets(paper, key, value, default):
    assert shown(read_settings(Path(paper)), key) == value
    assert shown(read_settings(None), key) == default


def test_every_setting_of_a_paper_that_departs_stands_on_the_page():
    told = {key for _, key, _, _ in rows()}
    for paper in PAPERS:
        ours = {one.key: one.value for one in every_setting(read_settings(None))}
        for one in every_setting(read_settings(Path(paper))):
            assert one.value == ours[one.key] or one.key in told, (paper, one.key)


@pytest.mark.parametrize("paper", PAPERS)
def test_a_robots_settings_may_be_named_by_their_paper(paper):
    settings = load_settings(Path(paper))
    assert settings.localiser.neighbourhood is NeighbourhoodSearch.BREADTH_FIRST
    assert settings.localiser.path_entries is PathEntries.MATCHES
    assert settings.localiser.success is Success.FIRST


# -- the rules themselves


def two_ways() -> ExperienceGraph:
    """Five nodes a metre apart in a chain; its ends also joined directly, but vaguely and wrongly.

    A sixth is joined by a proximity edge only, a seventh lies far off.
    """
    graph = ExperienceGraph()
    nodes = [make_node(0, i) for i in range(5)] + [make_node(1, 0), make_node(2, 0)]
    for node in nodes:
        graph.add_node(node)
    for a, b in pairwise(nodes[:5]):
        graph.add_edge(make_edge(a.id, b.id, forward(1.0)))
    vague = make_edge(nodes[0].id, nodes[4].id, forward(3.0), EdgeKind.MATCH)
    graph.add_edge(replace(vague, covariance=covariance_of(2.0, 0.1)))
    graph.add_edge(make_edge(nodes[2].id, nodes[5].id, forward(0.5), EdgeKind.PROXIMITY))
    graph.add_edge(make_edge(nodes[4].id, nodes[6].id, forward(9.0), EdgeKind.MATCH))
    return graph


def test_breadth_first_takes_the_chain_with_the_fewest_edges():
    graph, at = two_ways(), covariance_of(1e-3, 1e-4)
    search = Search(8.0, 1.0)
    plain = breadth_first(graph, 0, SE3.identity(), at, search)
    surest = graph.neighbourhood(0, SE3.identity(), at, search)
    assert plain.nodes.tolist() == [0, 1, 4, 2, 3]  # by edges: 0; 1 and 4; 2 and 3
    assert plain.along_m[2] == pytest.approx(-3.0)  # the direct edge
    assert surest.along_m[surest.nodes.tolist().index(4)] == pytest.approx(-4.0)  # the chain
    assert 5 in surest.nodes  # the papers have no proximity edges
    assert plain.sigma_m[2] > surest.sigma_m[surest.nodes.tolist().index(4)]


def test_breadth_first_predicts_as_the_search_kernel_where_there_is_one_chain():
    graph = ExperienceGraph()
    nodes = [make_node(0, i) for i in range(9)]
    for node in nodes:
        graph.add_node(node)
    step = SE3.exp([0.1, 0.0, 1.0, 0.0, 0.05, 0.0])
    for a, b in pairwise(nodes):
        graph.add_edge(make_edge(a.id, b.id, step))
    at, live = covariance_of(1e-2, 1e-3), SE3.exp([0.3, 0, 0.4, 0, 0.1, 0])
    search = Search(5.0, 1.2)
    plain, kernel = (
        breadth_first(graph, 4, live, at, search),
        graph.neighbourhood(4, live, at, search),
    )
    row = {int(node): place for place, node in enumerate(kernel.nodes)}
    assert len(plain) > 5
    for place, node in enumerate(plain.nodes.tolist()):
        for name in ("node_from_live", "along_m", "across_m", "yaw_rad", "sigma_m", "sigma_yaw_rad",
                     "pivot_in_node", "distance_m"):  # fmt: skip
            mine, theirs = getattr(plain, name)[place], getattr(kernel, name)[row[node]]
            np.testing.assert_allclose(mine, theirs, atol=1e-9, err_msg=name)


def test_paths_of_matches_do_not_count_saved_nodes_and_grow_along():
    graph, nodes = ExperienceGraph(), [make_node(0, i) for i in range(3)]
    for node in nodes:
        graph.add_node(node)
    memory = PathMemory(graph)
    path = path_id(nodes[0].session)
    kinds = (PathEntryKind.SAVED, PathEntryKind.MATCHED, PathEntryKind.MATCHED)
    matches = memory.counting(MATCHES_ONLY)
    for place, (node, kind) in enumerate(zip(nodes, kinds, strict=True)):
        memory.add(PathEntry(path, place, node.id, kind, place))
    every = np.arange(3, dtype=np.int32)
    assert memory.on_paths([path], every).tolist() == [[True, True, True]]
    assert matches.on_paths([path], every).tolist() == [[False, True, True]]
    assert memory.counting(MATCHES_ONLY) is matches
    assert list(matches.entries(path)) == list(memory.entries(path))


class Spy:
    """Ranks by distance and keeps W and the path memory of each frame."""

    name = "spy"

    def __init__(self) -> None:
        self.seen = []

    def rank(self, context):
        self.seen.append(context)
        return POLICIES["distance"]().rank(context)


def localise(path: Path, live, config: LocaliserConfig, **options):
    spy = Spy()
    with (
        Map.open(path) as opened,
        localiser_in(
            opened,
            live[0].frame.camera,
            replace(Settings(), localiser=config),
            policy=spy,
            relocaliser="exhaustive",
            **options,
        ) as localiser,
    ):
        found = localised(localiser, live)
    return found, spy.seen


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("papers") / "street.engram"
    map_simulated(path, drive(WORLD, ROAD))
    map_simulated(path, drive(WORLD, ROAD, 1, aside_m=0.3, start_ns=10**14, seed=4), "r2")
    return path


def test_failed_proposals_of_a_lost_robot_never_enter_w(street):
    """It starts without a position, in light that no node has, and then comes into the known."""
    appearance = np.where(ROAD < 12.0, 7, 0)
    live = drive(WORLD, ROAD, appearance, start_ns=10**15, seed=9)
    found, contexts = localise(street, live, LocaliserConfig(), budget=Budget(2, 2))
    assert sum(one.proposed for one in found) > 20
    assert any(one.localised for one in found)
    near = set()
    for context in contexts:
        near |= set(context.neighbourhood.nodes.tolist())
        failed = context.observations.nodes[~context.observations.succeeded]
        assert set(failed.tolist()) <= near


@pytest.mark.parametrize("paper", [True, False])
def test_a_robot_that_is_told_a_place_looks_elsewhere_at_once_only_by_our_default(street, paper):
    live = drive(WORLD, ROAD[-3:], 7, start_ns=10**15, seed=3)  # in light that no node has
    settings = Settings()
    config = settings.localiser
    if paper:
        doubt_after = load_settings(Path("linegar2015")).localiser.acceptance.doubt_after
        config = replace(config, acceptance=replace(config.acceptance, doubt_after=doubt_after))
    settings = replace(settings, localiser=config)
    with Map.open(street) as opened, localiser_in(
        opened, live[0].frame.camera, settings, policy="distance", relocaliser="exhaustive",
    ) as localiser:  # fmt: skip
        localiser.place_at(Position.at(opened.graph.node(0).id))
        found = localised(localiser, live)
    assert all(one.open_loop_m < config.lost_after_m for one in found)
    assert (sum(one.proposed for one in found) == 0) is paper


@pytest.mark.parametrize("success", list(Success))
def test_the_first_success_ends_the_frame_where_the_papers_settings_say_so(street, success):
    live = drive(WORLD, ROAD, start_ns=10**15, seed=2)
    config = LocaliserConfig(success=success)
    with Map.open(street) as opened, localiser_in(
        opened, live[0].frame.camera, replace(Settings(), localiser=config), policy="distance",
        budget=Budget(4, 1), relocaliser=None,
    ) as localiser:  # fmt: skip
        localiser.place_at(Position.at(opened.graph.node(0).id))
        successes = []
        for seen in live:
            (found,) = localised(localiser, [seen])
            successes.append(sum(one.accepted for one in localiser.outcomes))
            if found.localised and success is Success.FIRST:
                assert localiser.outcomes[-1].candidate.node == found.node
    assert (max(successes) == 1) is (success is Success.FIRST)


def test_breadth_first_and_paths_of_matches_reach_the_policy(street):
    live = drive(WORLD, ROAD[:6], start_ns=10**15, seed=2)
    paper = load_settings(Path("linegar2015")).localiser
    _, published = localise(street, live, paper)
    _, ours = localise(street, live, LocaliserConfig())
    assert published[-1].path_memory.kinds == MATCHES_ONLY
    assert ours[-1].path_memory.kinds > MATCHES_ONLY
    order, surest = (one[-1].neighbourhood.nodes.tolist() for one in (published, ours))
    assert order != surest
    assert sorted(order) == sorted(surest)  # one chain: the same nodes, fewest edges first


@pytest.fixture(scope="module")
def handed_in(tmp_path_factory):
    """A fleet map and a robot's drive of which the first half is known and the second is not."""
    folder = tmp_path_factory.mktemp("segments")
    places = np.arange(0.0, 30.0, 0.7)
    robot_map(folder / "first.engram", places)
    robot_map(folder / "half.engram", places, np.where(places < 20.0, 0, 1), name="r2", day=2)
    robot_map(folder / "same.engram", places, np.where(places < 26.0, 0, 1), name="r3", day=3)
    return folder


@pytest.mark.parametrize("name", ["half", "same"])
def test_a_segment_is_omitted_or_taken_as_a_whole(handed_in, tmp_path, name):
    whole = replace(OPTIONS, unit=Unit.SEGMENT, segment_share=0.8, sure_inliers=0)
    centre = tmp_path / "centre.engram"
    _, report = merged(
        centre, handed_in / "first.engram", handed_in / f"{name}.engram", asked=whole
    )
    for segment in report.segments:
        assert 0 in {segment.taken, segment.omitted}
    (longest,) = [one for one in report.segments if one.taken + one.omitted > 10]
    assert bool(longest.omitted) is (name == "same")
    if name == "half":
        assert {run.reason for run in longest.runs} == {Reason.WHOLE_SEGMENT}
    by_frame = tmp_path / "frames.engram"
    _, each = merged(by_frame, handed_in / "first.engram", handed_in / f"{name}.engram")
    assert all(one.taken and one.omitted for one in each.segments if one.taken + one.omitted > 10)
    with Map.open(centre) as store, Map.open(by_frame) as other:
        assert store.content_hash() != other.content_hash()
    assert Content.of(centre).nodes  # opens and reads


def test_segments_are_seeded_by_place_recognition_alone_where_the_paper_says_so(
    handed_in, tmp_path
):
    places = replace(OPTIONS, seed=SeedFrom.PLACES, relocaliser=None)
    centre = tmp_path / "centre.engram"
    merged(centre, handed_in / "first.engram")
    (report,) = merged(centre, handed_in / "half.engram", asked=places)
    assert report.omitted == 0  # nothing looks for places here, and neighbours do not count
    (ours,) = merged(tmp_path / "other.engram", handed_in / "half.engram")
    assert ours.taken > 0
    assert MergeOptions().seed is SeedFrom.NEIGHBOUR
