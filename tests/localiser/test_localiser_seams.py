"""The seams of the localiser: who matches, who searches, what the oracle foresees."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.builders import PERIOD_NS, TOWN, TOWN_ROAD, Seen, World, drive, localised, map_simulated

from engram.errors import MapCorruptError
from engram.localiser.attempts import Lanes, one_by_one
from engram.localiser.localisation import Budget, LocalisationStatus, Position
from engram.maps.map import Map
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.ranking.policies import POLICIES
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings


class _Counting(Lanes):
    """Matches as a robot does, and counts."""

    calls = 0
    matches = one_by_one

    def match(self, live, live_id, node, guide):
        self.calls += 1
        return super().match(live, live_id, node, guide)


class _Foreseeing:
    """Ranks by distance and keeps what it could foresee."""

    name = "foreseeing"

    def __init__(self) -> None:
        self.seen = []

    def rank(self, context):
        order = POLICIES["distance"]().rank(context)
        self.seen.append((context.foresee(), order, len(context.neighbourhood)))
        return order


def test_a_given_matcher_makes_all_attempts_and_a_given_search_finds_all_candidates(
    town: Path,
) -> None:
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)
    with Map.open(town) as opened:
        matcher = _Counting(opened.frames, Settings().localiser.matcher)
        searched = []

        def search(*args):
            searched.append(args)
            return opened.graph.neighbourhood(*args)

        with localiser_in(
            opened,
            live[0].frame.camera,
            Settings(),
            policy="distance",
            budget=Budget(3, 1),
            relocaliser=None,
            matcher=matcher,
            search=search,
        ) as localiser:
            localiser.place_at(Position.at(opened.graph.node(0).id))
            found = localised(localiser, live)
    assert all(one.node is not None for one in found)
    assert matcher.calls == sum(one.attempts for one in found) > 0
    assert len(searched) == len(live)


def test_a_robot_whose_odometry_sees_nothing_is_taken_to_go_on_within_a_bounded_radius(
    town: Path,
) -> None:
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)
    elsewhere = drive(World(30.0, seed=9), TOWN_ROAD, seed=2, start_ns=10**15)
    blind = OdometryStep(OdometryStatus.TOO_FEW_MATCHES)
    radii_m = []
    with Map.open(town) as opened:

        def search(*args):
            radii_m.append(args[-1].radius_m)
            return opened.graph.neighbourhood(*args)

        settings = Settings()
        with localiser_in(
            opened,
            live[0].frame.camera,
            settings,
            policy="distance",
            relocaliser=None,
            search=search,
        ) as localiser:
            localiser.place_at(Position.at(opened.graph.node(0).id))
            last_ns = live[9].frame.stamp_ns
            stamps_ns = range(last_ns + PERIOD_NS, last_ns + 121 * PERIOD_NS, PERIOD_NS)
            gone = [
                Seen(replace(seen.frame, stamp_ns=stamp_ns), blind, seen.world_from_live)
                for seen, stamp_ns in zip(elsewhere[10:16] * 20, stamps_ns, strict=True)
            ]
            found = localised(localiser, [*live[:10], *gone])
    known, lost = found[:10], found[10:]
    assert known[-1].status is LocalisationStatus.LOCALISED
    assert all(one.node is None for one in lost)
    before, after = known[-1].position, lost[5].position
    assert after.node == before.node
    driven = before.node_from_live.inverse() @ after.node_from_live
    # Six steps of 0.7 m, each as long as the last measured one, which is good to a few per cent.
    np.testing.assert_allclose(driven.translation, [0.0, 0.0, 4.2], atol=0.2)
    assert radii_m[0] < 10.0 < max(radii_m) == settings.localiser.max_search_radius_m


def test_what_is_foreseen_is_what_attempts_come_to(town: Path, monkeypatch) -> None:
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)[:10]
    policy = _Foreseeing()
    monkeypatch.setitem(POLICIES, policy.name, lambda: policy)
    with (
        Map.open(town) as opened,
        localiser_in(
            opened,
            live[0].frame.camera,
            Settings(),
            policy=policy.name,
            budget=Budget(1000, 1),
            relocaliser=None,
        ) as localiser,
    ):
        localiser.place_at(Position.at(opened.graph.node(0).id))
        robot = Robot(Front(Settings()), localiser)
        for seen in live:
            robot.step(seen.logged)
            foreseen, order, count = policy.seen[-1]
            assert foreseen.accepted.shape == foreseen.inliers.shape == (count,)
            made = localiser.outcomes
            assert [one.accepted for one in made] == foreseen.accepted[order].tolist()
            assert [one.match.inliers for one in made] == foreseen.inliers[order].tolist()
    assert policy.seen[-1][0].accepted.any()


class _Noting:
    """Ranks by distance and keeps the node k that it was given."""

    name = "noting"

    def __init__(self) -> None:
        self.references = []

    def rank(self, context):
        self.references.append(context.reference)
        return POLICIES["distance"]().rank(context)


def test_a_robot_is_localised_in_no_node_until_a_match_confirms_where_it_was_set_down(
    town: Path, monkeypatch
) -> None:
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)[:6]
    policy = _Noting()
    monkeypatch.setitem(POLICIES, policy.name, lambda: policy)
    with (
        Map.open(town) as opened,
        localiser_in(
            opened, live[0].frame.camera, Settings(), policy=policy.name, relocaliser=None
        ) as localiser,
    ):
        robot = Robot(Front(Settings()), localiser)
        localiser.place_at(Position.at(opened.graph.node(0).id))
        before = [robot.step(seen.logged) for seen in live[:3]]
        assert policy.references[0] is None
        for found, k in zip(before, policy.references[1:], strict=False):
            assert found.node is not None
            assert k == localiser.graph.index(found.node)
        localiser.place_at(before[-1].measured, agreed=3)
        robot.step(live[3].logged)
        assert policy.references[-1] == localiser.graph.index(before[-1].node)
        localiser.place_at(before[-1].measured)
        robot.step(live[4].logged)
        assert policy.references[-1] is None


class _Damaged(Lanes):
    """The landmarks of the map's first node cannot be read."""

    matches = one_by_one

    def __init__(self, opened: Map) -> None:
        super().__init__(opened.frames, Settings().localiser.matcher)
        self.first = opened.graph.node(0).id

    def match(self, live, live_id, node, guide):
        if node == self.first:
            raise MapCorruptError("damaged")
        return super().match(live, live_id, node, guide)


def test_what_is_damaged_is_foreseen_to_fail(town: Path, monkeypatch) -> None:
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)[:2]
    policy = _Foreseeing()
    monkeypatch.setitem(POLICIES, policy.name, lambda: policy)
    with (
        Map.open(town) as opened,
        localiser_in(
            opened,
            live[0].frame.camera,
            Settings(),
            policy=policy.name,
            relocaliser=None,
            matcher=_Damaged(opened),
        ) as localiser,
    ):
        localiser.place_at(Position.at(opened.graph.node(0).id))
        found = localised(localiser, live)
        assert found[0].damaged == (opened.graph.node(0).id,)
    foreseen = policy.seen[0][0]
    assert foreseen.accepted.any()
    assert not foreseen.accepted.all()


class _All:
    """Proposes nodes in their order, and remembers how many were asked for."""

    name = "all"
    new_place = None

    def __init__(self) -> None:
        self.asked = []

    def propose(self, live, count, allowed):
        self.asked.append(count)
        return [index for index in range(count) if allowed(index)]

    def carry_on(self, motion) -> None: ...
    def failed(self, nodes) -> None: ...
    def forget(self) -> None: ...


def test_a_lost_robot_has_a_budget_of_its_own_and_a_matcher_that_gives_up_sooner(
    town: Path,
) -> None:
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)
    relocaliser = _All()
    with (
        Map.open(town) as opened,
        localiser_in(
            opened,
            live[0].frame.camera,
            Settings(),
            budget=Budget(2, 1, lost_rounds=5),
            relocaliser=relocaliser,
        ) as localiser,
    ):
        found = localised(localiser, live)
    assert relocaliser.asked == [10]
    assert found[0].node is not None
    assert all(one.attempts <= 2 for one in found[1:])
    config = Settings().localiser
    assert config.lost_matcher.max_hypotheses < config.matcher.max_hypotheses
    assert replace(config, matcher=replace(config.matcher, max_hypotheses=7)).lost_matcher == (
        replace(config.lost_matcher, max_hypotheses=7)
    )


@pytest.mark.parametrize(("fixes_missed", "latest"), [(None, 1), (6, 8)])
def test_a_robot_that_is_elsewhere_than_it_believes_is_found_before_it_is_lost(
    tmp_path: Path, fixes_missed: int | None, latest: int
) -> None:
    """One that is only told its place looks at once; one that had fixes, when they stay away."""
    path = tmp_path / "town.engram"
    world, road = World(60.0), np.arange(0.0, 45.0, 0.7)
    map_simulated(path, drive(world, road))
    live = drive(world, road, seed=1, start_ns=10**15)[:40]
    with (
        Map.open(path) as opened,
        localiser_in(
            opened,
            live[0].frame.camera,
            Settings(),
            policy="distance",
            budget=Budget(20, 1),
            relocaliser=None,
        ) as localiser,
    ):
        nodes = sorted(opened.graph.nodes, key=lambda node: node.stamp_ns)
        wrong = Position.at(nodes[4].id)  # some four metres too far on
        localiser.place_at(wrong, agreed=0 if fixes_missed is None else 10)
        found = localised(localiser, live)
    where = [k for k, one in enumerate(found) if one.node is not None]
    assert (fixes_missed or 0) <= where[0] <= latest
    assert where == list(range(where[0], 40))
    for k in where:
        node = next(n for n in range(len(nodes)) if nodes[n].id == found[k].node)
        ahead_m = 0.7 * k - nodes[node].driven_m
        np.testing.assert_allclose(found[k].node_from_live.translation[2], ahead_m, atol=0.3)
