"""Anchors propose which nodes of two untied parts show the same; matches join them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.cli.frame import anchor
from engram.cli.options import SettingsGiven
from engram.maps.map import open_map
from engram.robot.anchors import IslandsConfig, anchor_map, join_islands
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions
from engram.sequences.opening import open_drive

METRES_PER_DEGREE = 111_320 * float(np.cos(np.deg2rad(50.0)))
# Nothing looks for a lost robot: each drive is a part of its own.
ALONE = RobotOptions(relocaliser=None)


@pytest.fixture
def parted(street: Path, tmp_path: Path) -> Path:
    """Two drives along the street, which nothing ties."""
    path = tmp_path / "parts.engram"
    map_drive(path, open_drive(street, frames="::2"), options=ALONE)
    map_drive(path, open_drive(street, frames="1::2"), options=ALONE)
    with open_map(path) as opened:
        assert len(np.unique(opened.graph.components())) == 2
    return path


def anchors(path: Path, shift_m: float) -> Path:
    """Anchors of all nodes along a circle of latitude; the second part lies off by `shift_m`."""
    lines = ["node,lat,lon,sigma"]
    with open_map(path) as opened:
        first_ns = min(node.stamp_ns for node in opened.graph.nodes)
        labels = opened.graph.components()
        for node, label in zip(opened.graph.nodes, labels, strict=True):
            # 0.8 m a frame of 0.1 s.
            east_m = 8.0 * (node.stamp_ns - first_ns) / 1e9 + shift_m * (label != labels[0])
            lines.append(f"{node.id},50.0,{14 + east_m / METRES_PER_DEGREE:.9f},1.0")
    given = path.with_suffix(".csv")
    given.write_text("\n".join(lines))
    return given


@pytest.mark.parametrize("shift_m", [1.5, 300.0])
def test_parts_at_one_place_are_joined_by_matches(parted: Path, shift_m: float) -> None:
    anchor_map(parted, anchors(parted, shift_m), author="tests")
    report = join_islands(parted, "tests", config=IslandsConfig(apart_m=3.0))
    with open_map(parted) as opened:
        parts = len(np.unique(opened.graph.components()))
        edges = {(str(edge.a), str(edge.b)) for edge in opened.graph.edges}
    if shift_m > 100:
        assert (parts, report.compared, report.text()) == (2, 0, "")
        return
    assert parts == 1
    assert len(report.joined) > 1
    assert set(report.joined) <= edges
    assert f"revision {report.revision}" in report.text()


def test_without_anchors_nothing_is_compared(parted: Path) -> None:
    assert join_islands(parted, "tests").compared == 0


@pytest.mark.parametrize(("apart_m", "parts"), [(100.0, 2), (3.0, 1)])
def test_the_verb_goes_by_the_settings_and_one_match_alone_joins_nothing(
    parted: Path, capsys: pytest.CaptureFixture[str], apart_m: float, parts: int
) -> None:
    given = SettingsGiven(changes=[f"islands.apart_m={apart_m}"])
    anchor(parted, anchors(parted, 0.0), settings=given)
    with open_map(parted) as opened:
        assert len(np.unique(opened.graph.components())) == parts
    assert ("none joins them" in capsys.readouterr().out) == (parts == 2)
