"""No robot claims a place by pictures that do not move with it: frozen ones, or its own bonnet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.graph.model import Clock, NodeId
from engram.localiser.localisation import Localisation
from engram.maps.map import Map, open_map
from engram.odometry.outside import OutsideMotion
from engram.robot.mapping import map_drive
from engram.sequences.sequence import SequenceInfo
from engram_lab.bench.data import synthetic_drive
from engram_lab.studies.faults.injected import (
    Shown,
    fixed_pattern,
    halved,
    never_moved,
    on_both,
    undisturbed,
)

STEP_M = 0.8
FRAMES = 24
AHEAD = OutsideMotion(SE3(np.eye(3), np.array([0.0, 0.0, STEP_M])), 0.1)
PARKED = OutsideMotion(SE3.identity(), 0.1)


class Drive(list[StereoPair]):
    """Pairs as a drive."""

    info = SequenceInfo("street", "pairs", Clock.RELATIVE, "robot")
    skipped = 0

    @property
    def camera(self):
        return self[0].camera


def noisy(pair: StereoPair, seed: int) -> StereoPair:
    rng = np.random.default_rng(seed)
    return on_both(
        pair, lambda one: np.clip(one + rng.normal(0, 1.0, one.shape), 0, 255).astype(np.uint8)
    )


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    drive = [halved(one, 2.0) for one in synthetic_drive(frames=FRAMES, step_m=STEP_M)]
    return [noisy(one, k) for k, one in enumerate(drive)]


@pytest.fixture(scope="module")
def street(pairs, tmp_path_factory) -> Iterator[Map]:
    yield from mapped(pairs, tmp_path_factory.mktemp("maps") / "street.engram")


def mapped(pairs: Sequence[StereoPair], path: Path) -> Iterator[Map]:
    map_drive(path, Drive(pairs))
    with open_map(path) as opened:
        yield opened


def later(shown: Sequence[Shown]) -> list[Shown]:
    """Another day, with other noise on what differs between frames."""
    return [
        replace(one, pair=replace(one.pair, stamp_ns=one.pair.stamp_ns + 10**12)) for one in shown
    ]


def claims(
    opened: Map, shown: Sequence[Shown], told: Sequence[OutsideMotion | None] | None = None
) -> list[tuple[int, float, Localisation]]:
    """Number, error in metres and result of each frame with a claim."""
    graph = opened.graph
    frame_of: dict[NodeId, int] = {one.id: one.stamp_ns // 100_000_000 for one in graph.nodes}
    claimed = []
    with opened.robot(shown[0].pair.camera) as robot:
        for k, one in enumerate(shown):
            found = robot.step(one.pair, motion=None if told is None or not k else told[k])
            if found.node is None or found.node_from_live is None:
                continue
            true_m = STEP_M * (one.frame - frame_of[found.node])
            off_m = found.node_from_live.translation - [0.0, 0.0, true_m]
            claimed.append((k, float(np.linalg.norm(off_m)), found))
    return claimed


def false(claimed: Sequence[tuple[int, float, Localisation]]) -> list[tuple[int, float]]:
    return [(k, error_m) for k, error_m, _ in claimed if error_m > 1.0]


def test_an_undisturbed_robot_is_localised(pairs, street) -> None:
    claimed = claims(street, later(undisturbed(pairs)))
    assert len(claimed) >= FRAMES - 1
    assert not false(claimed)


@pytest.mark.parametrize("burnt_in", [False, True])
@pytest.mark.parametrize("wheels", [False, True])
def test_a_stream_frozen_from_the_start_claims_nothing(pairs, street, burnt_in, wheels) -> None:
    frozen = never_moved(pairs, FRAMES, 0, np.random.default_rng(0), burnt_in=burnt_in)
    claimed = claims(street, later(frozen), [AHEAD] * FRAMES if wheels else None)
    assert not false(claimed)


def test_added_noise_does_not_hide_it_from_wheels(pairs, street) -> None:
    frozen = never_moved(pairs, FRAMES, 0, np.random.default_rng(0))
    noise = [replace(one, pair=noisy(one.pair, 100 + k)) for k, one in enumerate(frozen)]
    assert not false(claims(street, later(noise), [AHEAD] * FRAMES))


@pytest.mark.parametrize("noise", [False, True])
def test_a_stream_that_freezes_at_rest_claims_nothing_once_wheels_turn(
    pairs, street, noise
) -> None:
    rest = [noisy(pairs[5], 50 + k) for k in range(5)]
    after = [noisy(rest[-1], 60 + k) if noise else rest[-1] for k in range(15)]
    shown = [
        Shown(5 + max(0, k - 4), replace(one, stamp_ns=k * 100_000_000))
        for k, one in enumerate([*rest, *after])
    ]
    told = [PARKED] * 5 + [AHEAD] * 15
    claimed = claims(street, later(shown), told)
    assert not false(claimed)
    assert {k for k, _, _ in claimed} >= {1, 2, 3, 4}


@pytest.mark.parametrize("told", [None, PARKED])
def test_a_parked_robot_is_localised_throughout(pairs, street, told) -> None:
    parked = [
        Shown(8, replace(noisy(pairs[8], 200 + k), stamp_ns=k * 100_000_000)) for k in range(30)
    ]
    claimed = claims(street, later(parked), None if told is None else [told] * 30)
    assert len(claimed) == 30
    assert not false(claimed)


def test_a_simulator_without_noise_is_localised_at_rest_by_its_wheels(pairs, street) -> None:
    parked = [Shown(8, replace(pairs[8], stamp_ns=k * 100_000_000)) for k in range(10)]
    assert len(claims(street, later(parked), [PARKED] * 10)) == 10


@pytest.mark.parametrize(("share", "contrast"), [(0.2, 1.0), (0.4, 0.4), (0.5, 1.0)])
def test_a_bonnet_neither_shrinks_a_map_nor_is_a_place(pairs, tmp_path, share, contrast) -> None:
    shown = fixed_pattern(pairs, share, 0, np.random.default_rng(1), "bottom", 1.6, contrast)
    for opened in mapped([one.pair for one in shown], tmp_path / "bonnet.engram"):
        assert opened.graph.edges
        way_m = sum(edge.a_from_b.distance_m for edge in opened.graph.edges)
        assert way_m == pytest.approx(STEP_M * (FRAMES - 1), rel=0.1)
        claimed = claims(opened, later(shown))
        assert not false(claimed)
        assert len(claimed) > FRAMES / 2
        assert claimed[-1][2].fixed_share > 0.1
