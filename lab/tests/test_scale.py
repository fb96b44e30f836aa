"""Synthetic cities: sound maps in which a robot finds its way."""

from __future__ import annotations

from pathlib import Path

from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram_lab.studies.scale import City, Figures, ask, drive_in, table, write_in


def test_a_city_is_a_sound_map_that_localises(tmp_path: Path) -> None:
    city, path = City(3, length=26), tmp_path / "city.engram"
    city.write(path)

    assert check_file(path).problems == ()
    with Map.open(path) as opened:
        info = opened.info()
        assert (info.nodes, info.sessions, info.revision) == (390, 15, 3)
        assert info.edges / info.nodes > 7
        assert city.node(1, 2, 20).id in {node.id for node in opened.load().nodes}
    figures = drive_in(path, city)
    assert figures["localised (%)"] > 90
    before = path.read_bytes()
    assert all(seconds >= 0 for seconds in write_in(path, city).values())
    assert set(ask(path, city)) == {"info (s)", "log (s)", "show NODE (s)"}
    assert path.read_bytes() == before


def test_the_table_has_a_column_a_city() -> None:
    found = [Figures(5000, {"a": 1.0}), Figures(20000, {"a": 2.0, "b": 0.25})]

    assert table(found).splitlines() == [
        "| | 5,000 | 20,000 |",
        "| --- | --- | --- |",
        "| a | 1 | 2 |",
        "| b |  | 0.25 |",
    ]
