"""A robot that maps reads a map by pages, and saves what it would save on the whole graph."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.builders import Mapped, World, drive, map_simulated

from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind
from engram.graph.pages import PagedGraph
from engram.maps.map import Map

LAP_M = 2 * np.pi * 24.0
RING = World(LAP_M, radius_m=24.0, seed=5)
ROAD = np.arange(0.0, 1.2 * LAP_M, 1.0)


def drive_again(path: Path) -> Mapped:
    """A drive that looks like the mapped one on some stretches only."""
    appearance = np.where((np.arange(len(ROAD)) // 25) % 2, 0, 1)
    again = drive(RING, ROAD + 0.4, appearance, aside_m=0.5, start_ns=2 * 10**12, seed=3)
    return map_simulated(path, again, name="r2", policy="recall", closes_loops=True)


def dropped_each_frame(opened: Map) -> ExperienceGraph:
    return PagedGraph(opened.pages, 0)


def whole(opened: Map) -> ExperienceGraph:
    return opened.graph


@pytest.fixture(scope="module")
def lap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lap") / "ring.engram"
    map_simulated(path, drive(RING, ROAD), closes_loops=True)
    return path


@pytest.fixture(scope="module")
def as_whole(lap: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("whole") / "ring.engram"
    shutil.copy(lap, path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Map, "read_graph", whole)
        drive_again(path)
    with Map.open(path) as opened:
        added = [one for one in opened.graph.edges if one.kind is not EdgeKind.ODOMETRY]
        assert {one.kind for one in added} >= {EdgeKind.MATCH, EdgeKind.TIE, EdgeKind.PROXIMITY}
        return opened.content_hash()


@pytest.mark.parametrize("graph", [None, dropped_each_frame])
def test_a_second_drive_saves_the_same(
    lap: Path,
    as_whole: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    graph: Callable[[Map], ExperienceGraph] | None,
) -> None:
    shutil.copy(lap, path := tmp_path / "ring.engram")
    if graph is not None:
        monkeypatch.setattr(Map, "read_graph", graph)
    drive_again(path)
    with Map.open(path) as opened:
        assert opened.content_hash() == as_whole
