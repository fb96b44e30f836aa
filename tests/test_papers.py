"""The papers' settings: each rule in the page's table is what its file says, and departs or not."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.builders import World, covariance_of, drive, forward, localised, make_edge, map_simulated
from tests.fleet.robots import OPTIONS, merged, robot_map
from tests.fleet.test_updating import Content

from engram.cli.options import Effort
from engram.cli.settings import every_setting, read_settings
from engram.fleet.cli.verbs import _judge, merging_of
from engram.fleet.merge.merge_settings import MergeOptions, SeedFrom, Unit
from engram.fleet.merge.report import Reason
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind, PathEntry, PathEntryKind, path_id
from engram.graph.neighbourhood import Search
from engram.graph.paths import MATCHES_ONLY, PathMemory
from engram.graph.proximity import breadth_first
from engram.localiser.acceptance import Rule
from engram.localiser.localisation import Budget, Position
from engram.localiser.settings import LocaliserConfig, NeighbourhoodSearch, PathEntries, Success
from engram.maps.map import Map
from engram.measures import Drive, failure
from engram.ranking.policies import POLICIES
from engram.robot.localisers import localiser_in
from engram.robot.settings import PAPERS, Settings, load_settings
from engram.testing.contracts import make_node

PAGE = Path(__file__).parents[1] / "docs" / "paper-rules.md"
WORLD = World(30.0)
ROAD = np.arange(0.0, 25.0, 0.7)


# What shows of each row that its setting does what the row says, and that our default does not.
PROOFS = {
    "drive.ranking": "test_a_drive_attempts_as_its_paper_says",
    "drive.lanes": "test_a_drive_attempts_as_its_paper_says",
    "drive.rounds": "test_a_drive_attempts_as_its_paper_says",
    "localiser.success": "test_the_first_success_ends_the_frame_where_the_papers_settings_say_so",
    "localiser.neighbourhood": "test_breadth_first_and_paths_of_matches_reach_the_policy",
    "localiser.path_entries": "test_breadth_first_and_paths_of_matches_reach_the_policy",
    "localiser.recent.T": "tests.ranking.test_recent:"
    "test_window_holds_the_last_t_iterations_whatever_the_frame_rate",
    "localiser.recent.T_unit": "tests.ranking.test_recent:"
    "test_with_unit_frame_each_frame_is_an_iteration",
    "none; failed proposals of a lost robot never count": "test_failed_proposals_of_a_lost_robot_"
    "never_enter_w",
    "localiser.acceptance.min_inliers": "test_inliers_decide_by_the_papers_rule_and_confidence_by_"
    "ours",
    "localiser.acceptance.rule": "test_inliers_decide_by_the_papers_rule_and_confidence_by_ours",
    "localiser.guide_below_m": "test_no_prediction_guides_a_match_where_the_paper_says_so",
    "localiser.guide_below_rad": "test_no_prediction_guides_a_match_where_the_paper_says_so",
    "localiser.lost_after_m": "test_a_robot_relocalises_once_it_drove_as_far_as_is_set",
    "localiser.acceptance.doubt_after": "test_a_robot_that_is_told_a_place_looks_elsewhere_at_once_"
    "only_by_our_default",
    "mapper.landmarks": "tests.mapper.test_mapper:"
    "test_a_node_has_more_landmarks_than_the_live_frame",
    "mapper.sure_inliers": "tests.mapper.test_mapper:"
    "test_a_frame_that_matches_weakly_is_saved_unless_as_published",
    "merge.ranking": "test_a_merge_localises_by_the_ranking_and_the_places_of_its_paper",
    "merge.relocaliser": "test_a_merge_localises_by_the_ranking_and_the_places_of_its_paper",
    "merge.sure_inliers": "tests.fleet.test_merging:test_a_node_is_omitted_only_for_a_sure_match",
    "merge.unit": "test_a_segment_is_omitted_or_taken_as_a_whole",
    "merge.seed": "test_segments_are_seeded_by_place_recognition_alone_where_the_paper_says_so",
    "build.max_gap_m": "test_orders_are_judged_by_the_measure_of_their_paper",
    "build.estimator": "test_orders_are_judged_by_the_measure_of_their_paper",
    "download.window_min": "tests.fleet.test_download:"
    "test_tod_sends_what_was_saved_near_that_hour_over_midnight_too",
    "download.epoch_min": "tests.fleet.test_path_weights:"
    "test_epochs_are_those_of_the_clock_minute_by_minute",
    "download.best_percent": "tests.fleet.test_path_weights:test_best_paths_of_an_epoch",
    "download.buffer_min": "tests.fleet.test_path_weights:"
    "test_algorithm_3_finds_the_epochs_of_a_mission",
}


def table() -> list[list[str]]:
    """The cells of each rule in the page's table."""
    _, _, text = PAGE.read_text(encoding="utf-8").partition("| rule | setting |")
    lines = text.split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def rows() -> list[tuple[str, str, str, str]]:
    """Paper, key, its value and our default of each rule on the page that a setting gives."""
    found = []
    for rule, setting, default, _ in table():
        if given := re.fullmatch(r"`([\w.]+) = (.+)`", setting):
            paper = "gadd2016" if rule.startswith("[G16]") else "linegar2015"
            found.append((paper, given[1], given[2], default.strip("`")))
    return found


def shown(settings, key: str) -> str:
    (one,) = [one for one in every_setting(settings) if one.key == key]
    return str(one.value)


@pytest.mark.parametrize(("paper", "key", "value", "default"), rows())
def test_each_rule_of_the_page_is_what_its_file_sets(paper, key, value, default):
    assert shown(read_settings(Path(paper)), key) == value
    assert shown(read_settings(None), key) == default


def test_each_row_of_the_page_has_a_test_that_shows_it():
    told = {key for _, key, _, _ in rows()}
    told |= {setting for _, setting, _, _ in table() if setting.startswith("none; ")}
    assert len(table()) == len(rows()) + 1  # the rule without a setting
    assert told == PROOFS.keys()
    for proof in PROOFS.values():
        module, _, test = proof.rpartition(":")
        assert callable(getattr(import_module(module or __name__), test)), proof


def test_the_page_says_of_each_default_whether_it_is_the_papers():
    for (_, key, value, default), row in zip(
        rows(), [one for one in table() if one[1].startswith("`")], strict=True
    ):
        assert row[3].startswith("same") is (value == default), key


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


@pytest.mark.parametrize("paper", PAPERS)
def test_a_drive_attempts_as_its_paper_says(street, paper):
    """In light that no node has, nothing ends a frame but its budget."""
    published, ours = (Effort().over(read_settings(one)) for one in (Path(paper), None))
    of_robot = {"relocaliser": "fabmap", "threads": None, "memory_bytes": None}
    assert published == {"ranking": "path", "lanes": 2, "rounds": 1, **of_robot}
    assert ours == {"ranking": "recall", "lanes": 2, "rounds": 2, **of_robot}
    live = drive(WORLD, ROAD[-3:], 7, start_ns=10**15, seed=3)
    for asked in (published, ours):
        with Map.open(street) as opened, localiser_in(
            opened, live[0].frame.camera, Settings(), policy=asked["ranking"],
            budget=Budget(asked["lanes"], asked["rounds"]), relocaliser=None,
        ) as localiser:  # fmt: skip
            localiser.place_at(Position.at(opened.graph.node(20).id))
            localised(localiser, live[:1])
            assert len(localiser.outcomes) == asked["lanes"] * asked["rounds"]


def test_inliers_decide_by_the_papers_rule_and_confidence_by_ours(street):
    live = drive(WORLD, ROAD[:8], start_ns=10**15, seed=2)

    def share(**acceptance) -> float:
        published = load_settings(Path("linegar2015")).localiser
        asked = replace(published, acceptance=replace(published.acceptance, **acceptance))
        found, _ = localise(street, live, asked)
        return float(np.mean([one.localised for one in found]))

    never = {"min_confidence": 1e9, "min_confidence_lost": 1e9}
    assert share(**never) == 1.0
    assert share(**never, rule=Rule.CONFIDENCE) == 0.0  # our default
    assert share(min_inliers=20_000, min_inliers_lost=20_000, min_inliers_plausible=20_000) == 0.0


@pytest.mark.parametrize("paper", [True, False])
def test_no_prediction_guides_a_match_where_the_paper_says_so(street, paper):
    live = drive(WORLD, ROAD[:8], start_ns=10**15, seed=2)
    settings = load_settings(Path("linegar2015")) if paper else Settings()
    with (
        Map.open(street) as opened,
        localiser_in(
            opened, live[0].frame.camera, settings, policy="distance", relocaliser=None
        ) as localiser,
    ):
        localiser.place_at(Position.at(opened.graph.node(0).id))
        guided = set()
        for seen in live:
            localised(localiser, [seen])
            guided |= {one.candidate.guided for one in localiser.outcomes}
    assert (True in guided) is not paper


@pytest.mark.parametrize("lost_after_m", [10.0, 5.0])
def test_a_robot_relocalises_once_it_drove_as_far_as_is_set(street, lost_after_m):
    live = drive(WORLD, ROAD[-26:], 7, start_ns=10**15, seed=3)  # in light that no node has
    published = load_settings(Path("linegar2015")).localiser
    assert published.lost_after_m == 10.0
    with Map.open(street) as opened, localiser_in(
        opened, live[0].frame.camera,
        replace(Settings(), localiser=replace(published, lost_after_m=lost_after_m)),
        policy="distance", relocaliser="exhaustive",
    ) as localiser:  # fmt: skip
        localiser.place_at(Position.at(opened.graph.node(0).id))
        found = localised(localiser, live)
    driven_m = np.cumsum([0.7] * len(live))
    first = next(at for at, one in enumerate(found) if one.proposed)
    assert driven_m[first] == pytest.approx(lost_after_m, abs=1.5)


def test_a_merge_localises_by_the_ranking_and_the_places_of_its_paper(
    handed_in, tmp_path, monkeypatch
):
    asked = []

    def spied(*given, **options):
        asked.append((options["policy"], options["relocaliser"] is not None))
        return localiser_in(*given, **options)

    monkeypatch.setattr("engram.fleet.merge.replay.localiser_in", spied)
    ours = merging_of(read_settings(None))
    for paper, ranking in ((Path("gadd2016"), "path"), (None, "recall")):
        merging = merging_of(read_settings(paper))
        assert merging.relocaliser == ours.relocaliser == "fabmap"
        centre = tmp_path / f"{ranking}.engram"
        merged(centre, handed_in / "first.engram")
        asked.clear()
        merged(centre, handed_in / "half.engram", asked=merging)
        assert set(asked) == {(ranking, True)}


def test_orders_are_judged_by_the_measure_of_their_paper():
    """Two losses, of 3 and of 12 m: of the losses half are long, of the route a twenty-fifth is."""
    published, ours = (
        _judge("best", [Path("held-out")], read_settings(paper))
        for paper in (Path("gadd2016"), None)
    )
    matched = np.ones(50, bool)
    matched[[10, 11, 12]] = matched[20:32] = False
    drives = [Drive(np.ones(50), matched)]
    asked = [failure(drives, one.judge_at_m, one.estimator) for one in (published, ours)]
    assert published.judge_at_m == ours.judge_at_m == 10.0
    assert asked == [pytest.approx(0.5), pytest.approx((13 - 10) / 50)]


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
    places = replace(OPTIONS, seed=SeedFrom.PLACES, relocaliser="none")
    centre = tmp_path / "centre.engram"
    merged(centre, handed_in / "first.engram")
    (report,) = merged(centre, handed_in / "half.engram", asked=places)
    assert report.omitted == 0  # nothing looks for places here, and neighbours do not count
    (ours,) = merged(tmp_path / "other.engram", handed_in / "half.engram")
    assert ours.taken > 0
    assert MergeOptions().seed is SeedFrom.NEIGHBOUR
