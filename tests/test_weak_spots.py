"""Weak spots: a map made by hand whose answer is known, and what must hold of any history."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.maps.frames import CAMERA, frame
from tests.maps.maps import attempt, begin

from engram.errors import ConfigError
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Clock,
    Edge,
    EdgeKind,
    Goal,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    Session,
    node_id,
    path_id,
    session_id,
)
from engram.maps.map import Map
from engram.weak_spots import (
    HOURS,
    History,
    Places,
    WeakSpots,
    WeakSpotsConfig,
    Why,
    find_weak_spots,
    named,
    weakness_of,
)

_LENGTH = 100
_DAY_NS = 86_400 * 10**9
# A node each metre, straight ahead: the camera looks along z.
_STEP = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
_SIGMA = np.diag([1e-4] * 6)


def drive(day: int, hour: float) -> Session:
    """A drive of a day at an hour of day, on the meridian of Greenwich."""
    start_ns = 20_000 * _DAY_NS + day * _DAY_NS + int(hour * 3600e9)
    one = session_id("robot", CAMERA.id, start_ns, "hash")
    return Session(one, "robot", CAMERA.id, start_ns, Clock.UTC, longitude_deg=0.0)


def map_street(store: Map, session: Session) -> list[NodeId]:
    """Maps a straight street whole."""
    nodes: list[NodeId] = []
    with begin(store, session) as writer:
        for at in range(_LENGTH):
            stamp_ns = session.start_ns + at * 10**8
            one = Node(node_id(session.id, stamp_ns), session.id, stamp_ns, CAMERA.id, float(at))
            writer.add_node(one, frame(stamp_ns, count=20, seed=at))
            if nodes:
                writer.add_edge(Edge(nodes[-1], one.id, EdgeKind.ODOMETRY, _STEP, _SIGMA))
            entry = PathEntry(path_id(session.id), at, one.id, PathEntryKind.SAVED, stamp_ns)
            writer.add_path_entry(entry)
            nodes.append(one.id)
        writer.commit()
    return nodes


def remember(
    store: Map, session: Session, nodes: list[NodeId], matched: Iterable[int],
    failed: Iterable[int] = (),
) -> None:  # fmt: skip
    """Keeps the path of a drive that saved nothing, with failed attempts at some nodes."""
    with begin(store, session) as writer:
        for number, at in enumerate(matched):
            stamp_ns = session.start_ns + at * 10**8
            entry = PathEntry(
                path_id(session.id), number, nodes[at], PathEntryKind.MATCHED, stamp_ns
            )
            writer.add_path_entry(entry)
        tried = [attempt(at, nodes[at], nodes[at], accepted=False, inliers=3) for at in failed]
        writer.add_attempts(tried)
        writer.commit()


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mapped at nine; three mornings match it all, three nights miss 40 to 60 m of it."""
    path = tmp_path_factory.mktemp("weak") / "street.engram"
    lit = [at for at in range(_LENGTH) if not 40 <= at < 60]
    with Map.create(path) as store:
        nodes = map_street(store, drive(0, 9.0))
        for day in (1, 2, 3):
            remember(store, drive(day, 9.0), nodes, range(_LENGTH))
            remember(store, drive(day, 22.0), nodes, lit)
        with store.begin_revision(author="tests", message="", configuration={}) as writer:
            writer.add_mark(Goal("dock", nodes[50], SE3.identity()))
            writer.commit()
    return path


def found_in(path: Path, *hours: int) -> WeakSpots:
    with Map.open(path) as opened:
        return find_weak_spots(opened, hours=hours)


def test_the_stretch_that_nights_miss_is_named_first(street: Path) -> None:
    found = found_in(street)
    worst = found.spots[0]
    assert (round(worst.from_m), round(worst.to_m)) == (40, 60)
    assert worst.hours[0] <= 22 < worst.hours[1]
    assert worst.why is Why.LOST
    assert worst.missed > 0.6
    assert worst.goal == "dock"
    assert worst.goal_m == pytest.approx(0.5, abs=0.6)
    assert found.named_share <= 0.1
    assert found.unknown_hours == 0
    rate = found.weakness.rate
    assert rate[2, 22] > 5 * rate[0, 22]  # the same night elsewhere
    assert rate[2, 22] > 5 * rate[2, 9]  # the same place in the morning


def test_a_drive_through_it_at_that_hour_is_proposed(street: Path) -> None:
    advice = found_in(street, 9, 22).advice
    assert advice is not None
    assert advice.hours[0] <= 22 < advice.hours[1]
    assert advice.from_m <= 40.5
    assert advice.to_m >= 59.5
    assert 0.5 < advice.mends < 1


def test_only_the_hours_of_the_fleet_count(street: Path) -> None:
    found = found_in(street, 8, 9, 10)
    assert all(one.hours[0] >= 8 and one.hours[1] <= 11 for one in found.spots)
    assert found.weakness.demand_m[:, 22].sum() == 0


def test_what_was_never_driven_is_said_to_be_so(street: Path) -> None:
    worst = found_in(street, 12, 13, 14, 15).spots[0]
    assert worst.why is Why.NEVER
    assert worst.like_drives < 0.5


def test_a_mapped_night_is_no_evidence_against_the_night(tmp_path: Path) -> None:
    """The drive that saved its nodes had nothing to match: the next one has."""
    path = tmp_path / "night.engram"
    with Map.create(path) as store:
        map_street(store, drive(0, 22.0))
    rate = found_in(path).weakness.rate
    assert rate[:, 22].max() < rate[:, 12].min()


def test_failed_attempts_of_a_robot_that_saves_nothing_count(tmp_path: Path) -> None:
    path = tmp_path / "tried.engram"
    with Map.create(path) as store:
        nodes = map_street(store, drive(0, 9.0))
        remember(store, drive(1, 9.0), nodes, range(80), failed=range(80, _LENGTH))
    rate = found_in(path).weakness.rate[:, 9]
    assert rate[4] > 3 * rate[0]


def test_an_empty_map_has_no_weak_spot(tmp_path: Path) -> None:
    path = tmp_path / "empty.engram"
    Map.create(path).close()
    found = found_in(path)
    assert (found.spots, found.advice, found.drives) == ([], None, 0)


def test_latitude_tells_dusk_from_night() -> None:
    """In December at 52 degrees north 17 h is night, in June it is not."""
    for day, dark in ((350.0, True), (170.0, False)):
        history = one_place([23.0], day=day)
        like = weakness_of(PLACE, history, WeakSpotsConfig(latitude_deg=52.0)).like[0]
        assert bool(like[18] > 0.8) is dark


def test_a_wrong_setting_is_refused() -> None:
    with pytest.raises(ConfigError, match="share_percent"):
        WeakSpotsConfig(share_percent=0.0)


PLACE = Places(
    np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1), np.full(1, 20.0),
    np.zeros(1, np.int64), np.zeros((1, 2)),
)  # fmt: skip


def one_place(hours: list[float], day: float = 180.0) -> History:
    """Passes of one place, all of which matched."""
    count = len(hours)
    return History(
        np.array(hours), np.full(count, day), np.arange(count), np.full((count, 1), 20.0),
        np.zeros((count, 1)), np.zeros((count, 1)), np.zeros((count, 1), np.bool_),
    )  # fmt: skip


def places(count: int) -> Places:
    """Places in a row."""
    at = np.arange(count)
    zeros = np.zeros(count, np.int64)
    return Places(zeros, zeros, 20.0 * at, 20.0 * (at + 1), at, np.zeros((count, 2)))


@st.composite
def histories(draw: st.DrawFn) -> History:
    passes, count = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    seen = rng.integers(0, 6, (passes, count)).astype(np.float64)
    missed = np.floor(rng.random((passes, count)) * (seen + 1))
    weak = np.floor(rng.random((passes, count)) * (seen - missed + 1))
    return History(
        rng.uniform(0, 24, passes), np.full(passes, 180.0), rng.permutation(passes), seen, missed,
        weak, (rng.random((passes, count)) < 0.5) & (seen > 0),
    )  # fmt: skip


@given(histories(), st.data())
def test_more_successes_at_a_place_never_make_it_weaker(history: History, data) -> None:
    route, config = places(history.seen.shape[1]), WeakSpotsConfig()
    before = weakness_of(route, history, config).rate
    row = data.draw(st.integers(0, len(history) - 1)), data.draw(st.integers(0, len(route) - 1))
    missed = history.missed.copy()
    missed[row] = 0.0
    better = History(
        history.hour, history.day, history.order, history.seen, missed, history.weak, history.saved
    )
    assert (weakness_of(route, better, config).rate <= before + 1e-12).all()
    more = History(
        np.append(history.hour, data.draw(st.floats(0, 23.9))),
        np.append(history.day, 180.0),
        np.append(history.order, len(history)),
        *(
            np.vstack([counts, np.full(len(route), value)])
            for counts, value in ((history.seen, 5.0), (history.missed, 0.0), (history.weak, 0.0))
        ),
        np.vstack([history.saved, np.full(len(route), data.draw(st.booleans()))]),
    )
    assert (weakness_of(route, more, config).rate <= before + 1e-12).all()


@given(histories(), st.floats(0.5, 100.0))
def test_what_is_named_keeps_to_its_share(history: History, percent: float) -> None:
    route = places(history.seen.shape[1])
    config = WeakSpotsConfig(share_percent=percent)
    found = weakness_of(route, history, config)
    chosen = named(found, route, config)
    assert chosen.sum() <= percent / 100 * HOURS * len(route) + 1e-9
    assert found.rate[chosen].min(initial=1.0) >= config.least_percent / 100
    rest = found.expected_m[~chosen & (found.rate >= config.least_percent / 100)]
    assert not chosen.any() or found.expected_m[chosen].min() >= rest.max(initial=0.0) - 1e-12
