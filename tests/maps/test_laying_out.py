"""A commit lays out its own nodes alone, and to the bit as a layout of the whole map has them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind
from engram.graph.placing import MAP_FROM_CAMERA
from engram.maps import map as map_module
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.map_frame import all_places

from .maps import begin, node, node_frame, session

SIGMA = np.diag([0.05**2] * 3 + [0.01**2] * 3)
KINDS = (EdgeKind.MATCH, EdgeKind.PROXIMITY)


class Town:
    """Drives side by side along a road; each is committed with edges to earlier ones."""

    def __init__(self, store: Map) -> None:
        self.store = store
        self.lanes: dict[str, int] = {}
        self.rng = np.random.default_rng(3)

    def pose(self, name: str, at: int) -> SE3:
        bend = SE3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.03 * at, 0.0]))
        place = np.array([float(at), 2.0 * self.lanes[name], 0.0])
        return SE3(MAP_FROM_CAMERA.copy(), place) @ bend

    def edge(self, one: tuple[str, int], other: tuple[str, int], kind: EdgeKind) -> Edge:
        a_from_b = self.pose(*one).inverse() @ self.pose(*other)
        noise = SE3.exp(self.rng.normal(0, 0.02, 6))
        ends = (node(session(name), at).id for name, at in (one, other))
        spread = SIGMA * self.rng.uniform(1, 4)
        return Edge(*ends, kind, a_from_b @ noise, spread)

    def drive(self, name: str, count: int, others: tuple[str, ...] = (), gap: int = -1) -> None:
        """A drive of so many nodes, in two chains if there is a gap before one of them."""
        drive, self.lanes[name] = session(name), len(self.lanes)
        with begin(self.store, drive) as writer:
            for at in range(count):
                writer.add_node(node(drive, at), node_frame(drive, at))
                if at and at != gap:
                    writer.add_edge(self.edge((name, at - 1), (name, at), EdgeKind.ODOMETRY))
                for number, other in enumerate(others if at % 3 == 0 else ()):
                    writer.add_edge(self.edge((other, at), (name, at), KINDS[number % 2]))
            writer.commit()


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether each commit was laid out by its own rows; each of those is compared."""
    return []


@pytest.fixture
def town(location: Path, calls: list[bool], monkeypatch: pytest.MonkeyPatch) -> Iterator[Town]:
    with Map.create(location) as store:
        own_places = map_module.new_places

        def compared(connection, view, contents, own, config):
            found = own_places(connection, view, contents, own, config)
            calls.append(found is not None)
            if found is not None:
                whole = all_places(store, contents, config)
                assert [one.node for one in found] == [one.node for one in whole]
                for one, other in zip(found, whole, strict=True):
                    # A revert takes steps off a sum, whose rounding stays.
                    reverted = any("revert" in one.configuration for one in store.log())
                    atol = 1e-12 if reverted else 0.0
                    np.testing.assert_allclose(
                        one.map_from_node.matrix(), other.map_from_node.matrix(), rtol=0, atol=atol
                    )
            return found

        monkeypatch.setattr(map_module, "new_places", compared)
        yield Town(store)
    assert check_file(location).problems == ()


def test_drives_beside_others(town: Town, calls: list[bool]) -> None:
    town.drive("robot-1", 12)
    town.drive("robot-2", 12, ("robot-1",))
    town.drive("robot-3", 12, ("robot-2", "robot-1"))
    town.drive("robot-4", 10, ("robot-1", "robot-3"), gap=5)
    assert calls == [True] * 4


def test_parts_that_nothing_joins_stand_beside_the_others(town: Town, calls: list[bool]) -> None:
    town.drive("robot-1", 6)
    town.drive("robot-2", 5, gap=2)
    town.drive("robot-3", 1)
    town.drive("robot-4", 6, ("robot-1",), gap=4)
    assert calls == [True] * 4


@pytest.mark.parametrize("kind", [*KINDS, EdgeKind.ODOMETRY])
def test_measurements_made_again_move_nothing_but_steps_may(
    town: Town, calls: list[bool], kind: EdgeKind
) -> None:
    town.drive("robot-1", 12)
    town.drive("robot-2", 12, ("robot-1", "robot-1"), gap=7)
    drive, town.lanes["robot-3"] = session("robot-3"), 2
    with begin(town.store, drive) as writer:
        for at in range(9):
            writer.add_node(node(drive, at), node_frame(drive, at))
            if at:
                writer.add_edge(town.edge(("robot-3", at - 1), ("robot-3", at), EdgeKind.ODOMETRY))
            if at % 3 == 0:
                writer.add_edge(town.edge(("robot-1", at), ("robot-3", at), EdgeKind.MATCH))
                again = (("robot-1", at), ("robot-2", at))
                if kind is EdgeKind.ODOMETRY:
                    again = (("robot-1", at), ("robot-1", at + 1))
                writer.add_edge(town.edge(*again, kind))
        writer.commit()
    assert calls == [True, True, kind is not EdgeKind.ODOMETRY]


def test_what_comes_together_is_laid_out_with_the_whole_map(town: Town, calls: list[bool]) -> None:
    town.drive("robot-1", 8)
    town.drive("robot-2", 6)
    town.drive("robot-3", 6, ("robot-1", "robot-2"))
    assert calls == [True, True, False]
    placed = town.store.placements
    apart_m = [
        np.linalg.norm(
            placed[node(session("robot-1"), at).id].translation
            - placed[node(session("robot-2"), at).id].translation
        )
        for at in range(6)
    ]
    assert max(apart_m) < 3


def test_after_a_revert_later_drives_are_laid_out_by_themselves(
    town: Town, calls: list[bool]
) -> None:
    town.drive("robot-1", 8)
    town.drive("robot-2", 8, ("robot-1",))
    town.drive("robot-3", 8, ("robot-1",))
    town.store.revert(2, author="tests")
    town.drive("robot-4", 8, ("robot-3", "robot-1"))
    assert calls == [True] * 4
    town.store.revert("head", author="tests")
    assert town.store.totals().components == len(set(town.store.graph.components().tolist())) == 1
