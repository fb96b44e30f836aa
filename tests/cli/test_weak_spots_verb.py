"""`engram weak-spots` from images to the table, and on the page of a map."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.pages import check_page

import engram as library
from engram.sample.drives import write_drives


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of one of the two drives that ship; the other one is remembered in it."""
    folder = tmp_path_factory.mktemp("weak")
    write_drives(folder)
    library.map_drive(folder / "town.engram", library.open_drive(folder / "monday"))
    return folder / "town.engram"


def test_it_names_cells_draws_them_and_proposes_a_drive(engram, town: Path, tmp_path: Path) -> None:
    before = engram("weak-spots", town, "--json").json
    assert before["drives"] == 1
    assert before["advice"]["mends"] > 0
    assert engram("localise", town, town.parent / "tuesday", "--remember").status == 0
    picture = tmp_path / "weak.png"
    ran = engram("weak-spots", town, "--out", picture)
    assert ran.status == 0
    assert ran.out.splitlines()[-1].startswith("Drive this next: ")
    assert picture.read_bytes().startswith(b"\x89PNG")
    after = engram("weak-spots", town, "--json").json
    assert after["drives"] == 2
    # Tuesday was driven at noon and localised: noon is less weak than it was.
    noon = [engram("weak-spots", town, "--hours", "12-13", "--at", at, "--json").json["missed"]
            for at in (1, 2)]  # fmt: skip
    assert noon[1] < noon[0]
    assert after["named_share"] <= 0.1
    for spot in after["spots"]:
        assert 0 <= spot["from_m"] < spot["to_m"]
        assert 0.05 <= spot["missed"] <= 1
        assert 0 <= spot["hours"][0] < spot["hours"][1] <= 47


def test_the_page_of_a_map_shows_them(engram, town: Path, tmp_path: Path) -> None:
    page = tmp_path / "town.html"
    assert engram("report", town, "--out", page).status == 0
    words = " ".join(check_page(page.read_text()).words)
    assert "Weak spots" in words
    assert "Drive this next: " in words


@pytest.mark.parametrize("hours", ["6", "6-25", "six-ten"])
def test_wrong_hours_are_refused(engram, town: Path, hours: str) -> None:
    ran = engram("weak-spots", town, "--hours", hours)
    assert ran.status == 2
    assert "such as 6-22" in ran.err
