"""Maps from above: lines in the direction of the drive, starts, parts apart, strangers' names."""

from __future__ import annotations

import shutil
from pathlib import Path
from uuid import UUID
from xml.etree import ElementTree

import numpy as np
import pytest
from tests.builders import write_street

import engram
from engram.robot.anchors import add_goal, anchor_map
from engram.sample.drives import write_drives
from engram.viewing.drawings import (
    Panel,
    Track,
    _arrows,
    as_svg,
    draw_parts,
    map_above,
    parts_of,
    plot_map,
)
from engram.viewing.report import map_page

HOSTILE = "<script>alert(1)</script> $x$ \x1b[31m -->"


@pytest.fixture(scope="module")
def two_parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of two streets that nothing joins, the longer one first."""
    folder = tmp_path_factory.mktemp("parts")
    town = folder / "town.engram"
    street = write_street(folder / "street", frames=14)
    engram.map_drive(town, engram.open_drive(street, robot="r1"))
    write_drives(folder)
    other = engram.open_drive(folder / "monday", frames="0:12", robot="<b>r2</b> $x$")
    engram.map_drive(town, other)
    return town


def test_a_map_is_lines_that_start_somewhere(two_parts: Path) -> None:
    with engram.open_map(two_parts) as opened:
        parts = parts_of(opened)
        nodes = opened.node_count()
    assert parts.nodes == nodes
    first = parts.panels[0].tracks[0]
    (line,) = first.lines()
    np.testing.assert_array_equal(line, first.points_m)
    assert first.starts is not None
    assert first.starts.tolist() == [True] + [False] * (len(line) - 1)


def test_parts_that_nothing_joins_are_drawn_apart_and_say_so(two_parts: Path) -> None:
    with engram.open_map(two_parts) as opened:
        parts = parts_of(opened, title="town")
    titles = [panel.title for panel in parts.panels]
    assert titles[0].startswith("town: part 1 of 2, ")
    assert titles[1].endswith("not joined yet")
    assert "A part is what" in parts.caption("Colours: drives")
    sizes = [sum(len(track.points_m) for track in panel.tracks) for panel in parts.panels]
    assert sizes == sorted(sizes, reverse=True)
    assert parts.text() == ""


def test_parts_beyond_the_sixth_are_counted(two_parts: Path, monkeypatch) -> None:
    monkeypatch.setattr("engram.viewing.drawings._PARTS", 1)
    with engram.open_map(two_parts) as opened:
        parts = parts_of(opened)
    count = parts.above.sizes()[1]
    assert len(parts.panels) == 1
    assert parts.text() == f"1 smaller part ({count} nodes) not drawn"


def test_a_goal_is_drawn_in_its_part(two_parts: Path, tmp_path: Path) -> None:
    with engram.open_map(two_parts) as opened:
        parts = parts_of(opened)
    x, y = (float(value) for value in parts.panels[1].tracks[0].points_m[0])
    add_goal(two_parts, "dock", x, y, 0.0, author="a")
    with engram.open_map(two_parts) as opened:
        marks = [panel.marks for panel in parts_of(opened).panels]
    assert list(marks[0]) == []
    assert list(marks[1]) == ["dock"]


def anchored(town: Path, folder: Path, of_second: int) -> Path:
    """A copy of a map of two parts: two anchors hold the first one, so many the second."""
    copy, lines = folder / "anchored.engram", ["node,x,y"]
    shutil.copy(town, copy)
    with engram.open_map(copy) as opened:
        above = map_above(opened)
    for part, (across_m, count) in enumerate(((0.0, 2), (40.0, of_second))):
        nodes = np.flatnonzero(above.part == part)
        for node, along_m in zip(nodes[[0, -1]][:count], (0.0, 10.0), strict=False):
            uuid = UUID(bytes=above.placed.uuids[node].tobytes())
            lines.append(f"{uuid},{along_m},{across_m}")
    (folder / "anchors.csv").write_text("\n".join(lines))
    anchor_map(copy, folder / "anchors.csv", author="a")
    return copy


def test_parts_that_anchors_hold_are_drawn_together(two_parts: Path, tmp_path: Path) -> None:
    with engram.open_map(anchored(two_parts, tmp_path, of_second=2)) as opened:
        parts = parts_of(opened, title="town")
    assert [panel.title for panel in parts.panels] == ["town"]
    assert (parts.above.sizes(), parts.above.pieces()) == ([parts.nodes], [2])


def test_one_anchor_gives_no_direction_so_its_part_stays_apart(
    two_parts: Path, tmp_path: Path
) -> None:
    with engram.open_map(anchored(two_parts, tmp_path, of_second=1)) as opened:
        above = map_above(opened)
    assert (len(above.sizes()), above.pieces()) == (2, [1, 1])


def test_a_page_says_that_anchors_hold_what_no_drive_joins(two_parts: Path, tmp_path: Path) -> None:
    assert (
        "2 parts whose places relative to each other are unknown" in map_page(two_parts, []).verdict
    )
    together = map_page(anchored(two_parts, tmp_path, of_second=2), []).verdict
    assert together.endswith("mapped; anchors hold 2 unconnected pieces together.")


def test_arrows_point_along_the_line() -> None:
    there = np.array([[0.0, 0.0], [0.0, 4.0], [-4.0, 4.0]])
    headings = [np.rad2deg(heading) for _, heading in _arrows([there], 4.0)]
    assert headings == pytest.approx([90.0, 180.0])


def test_drives_the_same_way_share_their_arrows_and_others_keep_theirs() -> None:
    road = np.column_stack([np.arange(41.0), np.zeros(41)])
    one_way = _arrows([road], spacing_m=10.0)
    assert _places(_arrows([road] * 50, spacing_m=10.0)) == _places(one_way)
    headings = [heading_rad for _, heading_rad in _arrows([road, road[::-1]], spacing_m=10.0)]
    assert headings == pytest.approx([0.0] * 4 + [np.pi] * 4)


def _places(arrows: list[tuple[np.ndarray, float]]) -> list[tuple[float, ...]]:
    return [tuple(place.tolist()) for place, _ in arrows]


def test_nodes_that_are_one_dot_are_drawn_once() -> None:
    lap_m = np.column_stack([np.arange(0.0, 1000.0, 10.0), np.zeros(100)])
    laps = [lap_m + np.array([0.0, 1e-3 * number]) for number in range(30)]
    figure = draw_parts([Panel("city", [Track("monday", np.concatenate(laps))])])
    drawn = figure.axes[0].lines[0].get_xydata()
    np.testing.assert_array_equal(drawn, lap_m)


def test_a_page_gets_its_own_colours_and_a_text_for_the_blind() -> None:
    track = Track("a", np.array([[0.0, 0.0], [1.0, 2.0]]), chain=np.zeros(2, np.int64))
    drawn = as_svg(draw_parts([Panel("a title", [track])]), "a <map> from above")
    assert 'role="img" aria-label="a &lt;map&gt; from above"' in drawn
    assert "var(--ink)" in drawn
    assert "a title" in drawn
    assert "<?xml" not in drawn
    assert "http://" not in drawn.replace("http://www.w3.org/", "")


def test_names_of_strangers_stay_text(two_parts: Path, tmp_path: Path) -> None:
    track = Track(HOSTILE, np.zeros((1, 2)))
    drawn = as_svg(draw_parts([Panel(HOSTILE, [track], {HOSTILE: (0.0, 0.0)})]), HOSTILE)
    assert "<script" not in drawn
    assert "\x1b" not in drawn
    ElementTree.fromstring(drawn)
    plot_map(two_parts, tmp_path / "town.svg")
    assert "<b>r2" not in (tmp_path / "town.svg").read_text()
