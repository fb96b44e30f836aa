"""`engram try`: the tour on the drives that ship."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec as installed
from pathlib import Path

import pytest

from engram.cli import trying
from engram.cli.options import ExitStatus
from engram.sample.drives import DRIVES


@pytest.fixture(scope="module")
def toured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which every test of this module runs, empty at first."""
    return tmp_path_factory.mktemp("toured")


@pytest.fixture(autouse=True)
def _there(toured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(toured)


_FIRST: list[str] = []


@pytest.fixture
def tour(engram, _there: None) -> str:
    """What the first tour prints."""
    if not _FIRST:
        ran = engram("try")
        assert ran.status == 0, ran.err
        _FIRST.append(ran.out)
    return _FIRST[0]


def shown(text: str) -> list[str]:
    """The commands that a tour shows."""
    return [line.removeprefix("$ ") for line in text.splitlines() if line.startswith("$ ")]


def test_the_tour_maps_a_drive_and_localises_the_next_days_as_well_as_it_says(tour: str) -> None:
    assert "simulated" in tour
    assert "nothing wrong" in tour
    share = re.search(r"40 frames over 2\d\.\d m: ([\d.]+)% localised", tour)
    assert share is not None
    # Three quarters of Tuesday's drive lie in Monday's map, and the rest beyond it.
    assert 75 <= float(share[1]) <= 90
    fixes = re.search(r"of (\d+) fixes, half are within ([\d.]+) cm .* within ([\d.]+) cm", tour)
    assert fixes is not None
    assert int(fixes[1]) == round(float(share[1]) * 40 / 100)
    assert float(fixes[2]) < 4
    assert float(fixes[3]) < 20
    assert len(list(Path("engram-try/matches").glob("*_localised.png"))) >= 15


def test_the_commands_that_it_shows_do_the_same_when_they_are_typed(engram, tour: str) -> None:
    assert len(shown(tour)) == 6
    for command in shown(tour):
        words = shlex.split(command)
        assert words[0] == "engram"
        if words[1] in {"map", "view"}:  # the map is there, and the viewer is a window
            continue
        if words[1] == "plot" and installed("matplotlib") is None:
            continue
        ran = engram(*words[1:])
        assert ran.status == 0
        # The first line holds the result and no times.
        assert ran.out.splitlines()[0] in tour.splitlines()


def test_it_resumes_and_without_extras_names_them(engram, tour: str, monkeypatch) -> None:
    monkeypatch.setattr(trying, "find_spec", lambda _: None)
    Path("engram-try/map.png").unlink(missing_ok=True)
    ran = engram("try")
    assert ran.status == 0
    assert "nothing to do: the map already contains this drive" in ran.out
    assert "pip install 'engram-localisation[plots]'" in ran.out
    assert "pip install 'engram-localisation[view]'" in ran.out
    without_page = tour.replace("engram-try/tuesday.html or ", "")
    assert ran.out.splitlines()[-12:] == without_page.splitlines()[-12:]
    assert not Path("engram-try/map.png").exists()


def test_what_it_proposes_at_the_end_works(engram, tour: str) -> None:
    proposed = re.search(r"^  engram (map engram-try.*)$", tour, re.M)
    assert proposed is not None
    ran = engram(*shlex.split(proposed[1]))
    assert ran.status == 0
    assert ran.out.startswith("partly new area: ")


def test_the_drives_alone_are_drives_like_any_other(engram) -> None:
    ran = engram("try", "--drives-only", "--out", "drives")
    assert ran.status == 0
    assert "$" not in ran.out
    assert {one.name for one in Path("drives").iterdir()} == {
        name for drive in DRIVES for name in (drive.name, f"{drive.name}.truth.txt")
    }
    for drive in DRIVES:
        found = engram("drive", "info", f"drives/{drive.name}", "--json").json
        assert (found["pairs"], found["clock"]) == (40, "utc")


def test_another_drive_of_that_name_is_left_alone(engram) -> None:
    Path("mine/monday/left").mkdir(parents=True)
    Path("mine/monday/left/000000.png").write_bytes(b"mine")
    ran = engram("try", "--out", "mine")
    assert ran.status == ExitStatus.BAD_INPUT
    assert "mine/monday is there already" in ran.err
    assert "--out" in ran.err
    assert [one.name for one in Path("mine").rglob("*.*")] == ["000000.png"]


def test_ctrl_c_leaves_what_the_same_command_goes_on_with(engram, monkeypatch) -> None:
    def interrupted(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(trying, "_run", interrupted)
    ran = engram("try", "--out", "drives")
    assert ran.status == ExitStatus.INTERRUPTED
    assert "the same command resumes" in ran.err
    assert "$ engram doctor drives/monday" in ran.out


def test_a_step_that_fails_ends_the_tour_with_its_status(engram) -> None:
    Path("drives/street.engram").write_text("not a map")
    ran = engram("try", "--out", "drives")
    assert ran.status == ExitStatus.BAD_INPUT
    assert "drives/street.engram" in ran.err
    assert "localise" not in shown(ran.out)[-1]
