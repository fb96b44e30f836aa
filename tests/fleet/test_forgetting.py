"""What a fleet forgets: the rest stays connected, and nothing brings it back."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.builders import World, drive, map_simulated
from tests.maps.maps import begin, session

from engram.errors import ConfigError, InputError, RevisionError
from engram.fleet import forgetting
from engram.fleet.download.coverage import Coverage, expected_missed
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Stock
from engram.fleet.download.selections import coverage_for
from engram.fleet.download.updating import update
from engram.fleet.forgetting import (
    Retention,
    age_from_text,
    bridges_over,
    forget,
    region_from_text,
)
from engram.fleet.serving import going_order, serving_order
from engram.graph.model import EdgeKind
from engram.maps.forgetting import Chosen, erase_map
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.placed import SizedNodes

from .robots import DAY_NS, merged


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, fleet) -> Path:
    """Three drives: the first 24 m, what follows to 40 m, and the first 24 m unlike."""
    path = tmp_path_factory.mktemp("centre") / "centre.engram"
    merged(path, *(fleet[name][0] for name in ("first", "longer", "other")))
    return path


@pytest.fixture
def centre(tmp_path: Path, made: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(made, tmp_path / "centre.engram"))


def drive_of(path: Path, robot: str) -> str:
    with Map.open(path) as store:
        return next(str(one.id) for one in store.sessions.values() if one.robot == robot)


def nodes_of(path: Path) -> dict:
    """Nodes by session."""
    found: dict = {}
    with Map.open(path) as store:
        for node in store.load().nodes:
            found.setdefault(str(node.session), set()).add(node.id)
    return found


def test_what_passed_through_stays_connected(centre: Path, fleet) -> None:
    with Map.open(centre) as store:
        places, before = store.read_placements(), store.totals()
        middle = sorted(one for one in fleet["longer"][1].saved if one in places)
        middle = sorted(middle, key=lambda node: places[node].translation[0])
        at = places[middle[len(middle) // 2]].translation[:2]
    done = forget(centre, Retention(region=(*at.tolist(), 2.0)), author="tests")
    assert done.nodes > 0
    assert done.bridges > 0
    assert done.components == (before.components, before.components)
    with Map.open(centre) as store:
        kinds = [edge.kind for edge in store.graph.edges]
        assert kinds.count(EdgeKind.BRIDGE) == done.bridges
        for node, pose in store.read_placements().items():
            assert (pose.matrix() == places[node].matrix()).all()
            assert np.hypot(*(pose.translation[:2] - at)) > 2.0
        assert store.totals().nodes == before.nodes - done.nodes
        store.revert("head", author="tests")
        assert store.totals().agrees(before)
    assert check_file(centre).problems == ()


def test_handed_in_again_what_was_forgotten_stays_forgotten(
    centre: Path, tmp_path: Path, fleet
) -> None:
    gone, before = drive_of(centre, "r4"), nodes_of(centre)
    del before[gone]
    forget(centre, Retention(sessions=(gone,)), author="tests", why="asked by the owner")
    for _ in ("hidden", "erased"):
        (report,) = merged(centre, fleet["other"][0])
        assert (report.changed, report.taken) == (False, 0)
        assert report.forgotten == len(fleet["other"][1].saved)
        assert "left out, as forgotten by the fleet" in report.text()
        assert nodes_of(centre) == before
        erase_map(centre)
    both = tmp_path / "both.engram"  # of a map that holds more, the rest is merged
    merged(both, fleet["other"][0], fleet["same"][0])
    (report,) = merged(centre, both)
    assert (report.changed, report.sessions) == (True, 1)
    found = nodes_of(centre)
    assert {one: found[one] for one in before} == before
    assert gone not in found
    assert check_file(centre).problems == ()


def test_robots_learn_of_it_with_their_next_download(centre: Path, tmp_path: Path, fleet) -> None:
    robot, sent = tmp_path / "robot.engram", tmp_path / "sent.engram"
    shutil.copy(fleet["other"][0], robot)
    gone, own = drive_of(centre, "r4"), len(fleet["other"][1].saved)
    forget(centre, Retention(sessions=(gone,)), author="tests")
    erase_map(centre)
    download(centre, sent, DownloadOptions())
    assert gone not in nodes_of(sent)
    done = update(sent, robot)
    assert done.forgotten == own
    assert gone not in nodes_of(robot)
    assert check_file(robot).problems == ()
    again = update(sent, robot)
    assert (again.revision, again.forgotten) == (None, 0)
    (report,) = merged(centre, robot)
    assert not report.changed
    # A download of the time before brings nothing back, either.
    older = tmp_path / "older.engram"
    merged(older, fleet["first"][0], fleet["other"][0])
    update(older, robot)
    assert gone not in nodes_of(robot)
    assert check_file(robot).problems == ()


def test_single_nodes_stay_forgotten_with_those_omitted_for_them(
    centre: Path, tmp_path: Path, fleet
) -> None:
    merged(centre, fleet["same"][0])  # omitted for those of the first
    with Map.open(centre) as store:
        omitted = {one for one in fleet["same"][1].saved if one in store.omissions}
        place = store.placements[store.omissions[min(omitted)].node].translation
    done = forget(centre, Retention(region=(*place[:2].tolist(), 1.0)), author="tests")
    erase_map(centre)
    before = nodes_of(centre)
    (first, same) = merged(centre, fleet["first"][0], fleet["same"][0])
    assert first.forgotten > 0
    assert same.forgotten > 0
    assert done.nodes >= first.forgotten
    assert nodes_of(centre) == before
    robot = tmp_path / "robot.engram"
    shutil.copy(fleet["first"][0], robot)
    assert update(centre, robot).forgotten == first.forgotten
    assert check_file(robot).problems == ()


def test_old_drives_and_pictures_are_chosen(tmp_path: Path) -> None:
    with Map.create(tmp_path / "town.engram") as store:
        for day in range(3):
            begin(store, session(f"r{day}", start_ns=day * DAY_NS)).commit()
        for days, robots in ((3.5, set()), (2.5, {"r0"}), (0.5, {"r0", "r1", "r2"})):
            old = Retention(older_than_days=days).chosen(store, 3 * DAY_NS)
            assert {store.sessions[one].robot for one in old.sessions} == robots
        every = Retention(pictures=True).chosen(store, 0)
        assert every.sessions == store.sessions.keys()
        assert every.pictures
        with pytest.raises(InputError, match="0 sessions begin with"):
            Retention(sessions=("xyz",), region=(0.0, 0.0, 1e6)).chosen(store, 0)
        with pytest.raises(InputError, match="--older-than"):
            Retention().chosen(store, 0)


def test_a_cap_takes_first_what_serves_least(centre: Path, fleet) -> None:
    """The drives of the first 24 m are alike but for one that looks different."""
    alone = fleet["other"][1].saved
    with Map.open(centre) as store:
        stock = Stock(store)
        size_bytes = sum(map(sum, stock.sizes)) + 2600 * len(stock)
        order = [stock.node_ids[at] for at in serving_order(stock)[0]]
        assert sorted(order) == sorted(stock.node_ids)
        first = np.isin(np.arange(len(stock)), serving_order(stock)[0][: len(stock) // 2])
        coverage = coverage_for(stock, DownloadOptions(select="budget"))
        assert expected_missed(coverage, first) < expected_missed(coverage, ~first)
        half = Retention(down_to=(None, 50.0)).chosen(store, 0).nodes
        less = Retention(down_to=(int(0.8 * size_bytes), None)).chosen(store, 0).nodes
        assert 0 < len(less) < len(half) < len(order)
        assert less <= half == set(order[-len(half) :])
        landmarks, pictures = store.lookups.blob_sizes(sorted(half)).T
        assert (landmarks + pictures).sum() + 2600 * len(half) >= size_bytes / 2
        of_one = Retention(sessions=(drive_of(centre, "r4"),), down_to=(None, 95.0))
        assert of_one.chosen(store, 0).nodes <= alone.keys()
        with pytest.raises(InputError, match="are not reached"):
            replace(of_one, down_to=(1, None)).chosen(store, 0)
    with pytest.raises(RevisionError, match="nothing that is to be forgotten"):
        forget(centre, Retention(down_to=(10**12, None)), author="tests")
    assert forget(centre, Retention(down_to=(None, 50.0)), author="tests").nodes == len(half)
    assert check_file(centre).problems == ()


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives of 200 m, alike on some stretches."""
    world, path = World(200.0, seed=5), tmp_path_factory.mktemp("road") / "road.engram"
    for number, step_m in enumerate((1.0, 1.3, 0.9)):
        places = np.arange(0.0, 190.0, step_m)
        appearance = np.where((np.arange(len(places)) // 25) % 2, 0, number)
        again = drive(world, places, appearance, start_ns=(number + 1) * DAY_NS, seed=number)
        map_simulated(path, again, name=f"r{number}", policy="recall")
    return path


def test_patches_of_a_map_are_judged_as_the_whole(road: Path) -> None:
    """Patches of 50 m: most of the map lies beyond what is read for each."""
    with Map.open(road) as store:
        nodes, stock = store.sized(), Stock(store)
        order, _ = serving_order(stock)
        whole = np.searchsorted(nodes.keys, stock.indices[order] + 1)[::-1]
        np.testing.assert_array_equal(going_order(store, nodes), whole)
        found = going_order(store, nodes, len(nodes) // 4)
        np.testing.assert_array_equal(np.sort(found), np.arange(len(nodes)))
        coverage = coverage_for(stock, DownloadOptions(select="budget"))
        for percent in (80, 50, 30):
            by_patches, best, random = (
                missed_with(coverage, nodes, stock, some[len(some) * (100 - percent) // 100 :])
                for some in (found, whole, np.random.default_rng(0).permutation(len(nodes)))
            )
            assert best <= by_patches < best + 0.1 * (random - best)


def between(store: Map, begin_m: float, end_m: float) -> Chosen:
    """The nodes of all drives on a stretch."""
    some = [one.id for one in Stock(store).nodes if begin_m <= one.driven_m <= end_m]
    return Chosen(nodes=frozenset(some))


def scattered(store: Map, share: float) -> Chosen:
    ids = [one.id for one in Stock(store).nodes]
    drawn = np.random.default_rng(int(100 * share)).random(len(ids)) < share
    return Chosen(nodes=frozenset(one for one, goes in zip(ids, drawn, strict=True) if goes))


@pytest.mark.parametrize(
    "choose",
    [partial(scattered, share=share) for share in (0.1, 0.5, 0.9)]
    + [partial(between, begin_m=50.0, end_m=150.0)],
)
def test_what_goes_is_bridged_group_by_group_as_at_once(
    road: Path, monkeypatch: pytest.MonkeyPatch, choose: Callable[[Map], Chosen]
) -> None:
    monkeypatch.setattr(forgetting, "_GROUP", 5)
    with Map.open(road, writes=True) as store:
        chosen = choose(store)
        at_once, in_groups = (bridges_over(store, chosen, whole) for whole in (10**6, 0))
        left = {(one.a, one.b): one for one in in_groups}
        assert len(left) == len(in_groups)
        # At least what was found at once; a group does not see what connects its surroundings.
        assert len(left.keys() & {(one.a, one.b) for one in at_once}) >= 0.95 * len(at_once)
        for bridges in (at_once, in_groups):
            done = store.forget_nodes(
                chosen, bridges, author="tests", message="", configuration={}, dry_run=True
            )
            assert done.components == (1, 1)


@pytest.mark.parametrize("whole", [0, 10**6])
def test_a_long_bridge_is_bridged_again(road: Path, tmp_path: Path, whole: int) -> None:
    """Its far end lies beyond what is read around a node that goes."""
    shutil.copy(road, path := tmp_path / "road.engram")
    with Map.open(path, writes=True) as store:
        for begin_m, end_m in ((50.0, 120.0), (40.0, 49.0)):
            chosen = between(store, begin_m, end_m)
            done = store.forget_nodes(
                chosen,
                bridges_over(store, chosen, whole),
                author="tests",
                message="",
                configuration={},
            )
            assert done.components == (1, 1)


def missed_with(
    coverage: Coverage, nodes: SizedNodes, stock: Stock, kept: NDArray[np.int64]
) -> float:
    """The expected share of the route without a match if only these rows of nodes are kept."""
    return expected_missed(coverage, np.isin(stock.indices, nodes.keys[kept] - 1))


def test_a_cap_that_is_kept_takes_nothing_more(centre: Path) -> None:
    """What is forgotten stays in the file until it is erased, but counts no longer."""
    cap_bytes = int(0.7 * centre.stat().st_size)
    cap = Retention(down_to=(cap_bytes, None))
    forgotten = forget(centre, cap, author="tests")
    before_bytes = centre.stat().st_size
    assert before_bytes > cap_bytes
    with pytest.raises(RevisionError, match="nothing that is to be forgotten"):
        forget(centre, cap, author="tests")
    erase_map(centre)
    assert before_bytes - centre.stat().st_size > forgotten.size_bytes > 0


def test_where_nothing_lies_nothing_is_forgotten(centre: Path) -> None:
    with pytest.raises(RevisionError, match="nothing that is to be forgotten"):
        forget(centre, Retention(region=(1e6, 1e6, 1.0)), author="tests")


def test_regions_and_ages_are_read_as_typed() -> None:
    assert region_from_text("120,-40.5,30") == (120.0, -40.5, 30.0)
    assert age_from_text("90d") == 90.0
    for text in ("", "1,2", "1,2,0", "1,2,nan", "a,b,c", "1,2,3,4"):
        with pytest.raises(ConfigError, match="--region"):
            region_from_text(text)
    for text in ("", "90", "d", "-1d", "infd", "1w"):
        with pytest.raises(ConfigError, match="--older-than"):
            age_from_text(text)
