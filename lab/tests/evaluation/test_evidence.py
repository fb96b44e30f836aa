"""The table of all studies: its commands run, its results have states, its pages are as drawn."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer
from tests.cli.conftest import engram

from engram.cli.app import app
from engram.errors import ConfigError, InputError
from engram_lab.studies import evidence, pages, paper_figures
from engram_lab.studies.evidence import (
    MANIFEST,
    STUDIES,
    Manifest,
    Planned,
    State,
    Study,
    fitting,
    plan,
    read_manifest,
    run_all,
    run_study,
    words_of,
)
from engram_lab.studies.page_pictures import POLICIES, content_of, order_by_policy
from engram_lab.studies.plan import write_csv

__all__ = ["engram"]

ROOT = Path(__file__).parents[3]
COMMANDS = [command for study in STUDIES.values() for command in study.commands]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_one_that_the_program_takes(command: str, tmp_path: Path) -> None:
    words = [word for word in words_of(command, tmp_path) if "*" not in word]
    if words[0] != "engram":
        assert words[:2] == ["python", "-m"]
        assert find_spec(words[2]) is not None
        return
    verb = typer.main.get_command(app)
    rest = words[1:]
    while hasattr(verb, "commands"):
        verb, rest = verb.commands[rest[0]], rest[1:]
    verb.make_context("engram", rest, resilient_parsing=True)  # refuses what the verb does not take
    known = {option for one in verb.params for option in (*one.opts, *one.secondary_opts)}
    assert {word for word in rest if word.startswith("--")} <= known


def test_every_page_that_a_study_names_is_there_and_its_prints_are_of_a_command() -> None:
    for name, study in STUDIES.items():
        assert [one for one in study.pages if not (ROOT / one).exists()] == [], name
        printed = [int(one[0]) for one in study.tables if re.fullmatch(r"\d\.txt", one)]
        assert all(1 <= one <= len(study.commands) for one in printed), name


def test_every_program_that_evidence_and_readme_name_is_of_a_study() -> None:
    text = "".join((ROOT / one).read_text() for one in ("README.md", "docs/evidence.md"))
    named = re.findall(r"engram_lab\.checks\.\w+", text)
    assert named
    run = "\n".join(COMMANDS)
    assert [one for one in named if one not in run] == []


ABOUT = Study(("python -m platform", "python -m json.tool {out}/given.json"), 6, (), ())


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> None:
    """A table of two studies that take no time."""
    table = {"first": ABOUT, "long": replace(ABOUT, minutes=600, resumes=True)}
    monkeypatch.setattr(evidence, "STUDIES", table)


def states(out: Path) -> dict[str, State]:
    return {one.name: one.state for one in plan(out)}


@pytest.mark.usefixtures("two")
def test_a_study_resumes_at_the_command_that_failed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"exit status \d of: python -m json.tool"):
        run_study("first", tmp_path)
    folder = tmp_path / "first"
    assert states(tmp_path) == {"first": State.BEGUN, "long": State.MISSING}
    printed = (folder / "1.txt").read_text()
    assert printed.strip()
    (folder / "1.txt").write_text("not again")
    (folder / "given.json").write_text('{"a": 1}')
    assert run_study("first", tmp_path)
    assert (folder / "1.txt").read_text() == "not again"
    assert '"a": 1' in (folder / "2.txt").read_text()
    known = read_manifest(folder)
    assert known.is_done
    assert known.seconds > 0
    assert known.settings["frontend.landmarks"] > 0
    assert states(tmp_path)["first"] is State.DONE


@pytest.mark.usefixtures("two")
def test_a_study_whose_time_is_over_is_begun(tmp_path: Path) -> None:
    assert not run_study("long", tmp_path, within_s=0.0)
    assert states(tmp_path)["long"] is State.BEGUN
    assert read_manifest(tmp_path / "long").ran == 0


def pretend(line: str, folder: Path, printed: str, within_s: float | None) -> int:
    """As `run_command`: the second command of `ABOUT` fails where it was given nothing."""
    (folder / printed).write_text(line)
    return int("given" in line and not (folder / "given.json").exists())


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("change", [{"method": 1}, {"world": 1}, {"commands": ("engram try",)}])
def test_results_of_another_version_are_stale_and_set_aside(
    tmp_path: Path, monkeypatch, change: dict
) -> None:
    monkeypatch.setattr(evidence, "run_command", pretend)
    folder = tmp_path / "first"
    folder.mkdir()
    old = replace(Manifest.now("first"), started="2026-01-02T03:04:05", ran=2, **change)
    evidence._write(folder, old)
    (folder / "table.csv").write_text("old")
    (folder / "given.json").write_text("{}")
    assert states(tmp_path)["first"] is State.STALE
    with pytest.raises(InputError):  # what it was given is set aside, too
        run_study("first", tmp_path)
    assert not (folder / "table.csv").exists()
    assert [one.read_text() for one in tmp_path.glob("first.*/table.csv")] == ["old"]


@pytest.mark.usefixtures("two")
def test_one_study_that_fails_leaves_the_others_to_be_run(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(evidence, "run_command", pretend)
    (tmp_path / "long").mkdir()
    (tmp_path / "long" / "given.json").write_text("{}")
    said: list[str] = []
    assert run_all(tmp_path, tell=said.append) == ["first"]
    assert states(tmp_path) == {"first": State.BEGUN, "long": State.DONE}
    assert any("exit status" in one for one in said)


@pytest.mark.usefixtures("two")
def test_what_fits_is_run_whole_and_a_long_one_that_resumes_has_the_rest() -> None:
    rows = [
        Planned("first", State.MISSING, 6.0, (0, 0)),
        Planned("long", State.BEGUN, 600.0, (0, 0)),
    ]
    assert list(fitting(rows, None)) == [("first", None), ("long", None)]
    assert list(fitting(rows, 1.0)) == [("first", None), ("long", 60 * 54.0)]
    assert list(fitting(rows, 0.05)) == [("long", 180.0)]
    assert list(fitting([replace(one, state=State.DONE) for one in rows], 9.0)) == []


def test_a_study_that_needs_real_images_says_so(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("ENGRAM_DATA", raising=False)
    (found,) = plan(tmp_path, ["real-images"])
    assert found.state is State.NO_DATA
    assert list(fitting([found], 1.0)) == []
    with pytest.raises(ConfigError, match="no study 'nothing'; the studies are real-images"):
        plan(tmp_path, ["nothing"])


def test_a_damaged_manifest_is_named(tmp_path: Path) -> None:
    (tmp_path / "scale").mkdir()
    (tmp_path / "scale" / MANIFEST).write_text("[1]")
    with pytest.raises(InputError, match=r"manifest\.json: is not a study's manifest"):
        plan(tmp_path, ["scale"])


def test_the_plan_is_shown_and_runs_nothing(engram, tmp_path: Path) -> None:
    ran = engram("lab", "evaluate", "all", "--plan", "--out", tmp_path / "results")
    assert ran.status == 0
    assert set(STUDIES) <= {line.split()[0] for line in ran.out.splitlines() if line}
    assert not (tmp_path / "results").exists()


# -- pages


@pytest.mark.parametrize("page", pages.pages(ROOT), ids=lambda page: page.name)
def test_blocks_of_a_page_are_as_their_tables_have_them(page: Path) -> None:
    text = page.read_text()
    assert pages.redrawn(text, ROOT / pages.TABLES) == text, (
        "run: python -m engram_lab.studies.pages draw"
    )


def test_a_page_shows_the_studies_that_name_it_drawn_or_by_hand() -> None:
    shown: dict[str, set[str]] = {}
    for page, names in pages.pages(ROOT).items():
        shown.setdefault(str(page.relative_to(ROOT)), set()).update(
            pages.BLOCKS[name].study for name in names
        )
    for page, studies in pages.by_hand(ROOT).items():
        assert set(studies) <= set(STUDIES), page
        shown.setdefault(str(page.relative_to(ROOT)), set()).update(studies)
    wanted: dict[str, set[str]] = {}
    for name, study in STUDIES.items():
        for page in study.pages:
            if not page.startswith("lab/"):
                wanted.setdefault(page, set()).add(name)
    # Reports also have figures of studies that they need not draw.
    assert {page: some for page, some in shown.items() if not page.startswith("lab/")} == wanted


def test_every_block_is_in_a_page() -> None:
    shown = {name for names in pages.pages(ROOT).values() for name in names}
    assert shown == set(pages.BLOCKS)


def test_pictures_are_drawn_from_the_tables_that_are_kept() -> None:
    for name, picture in pages.pictures(ROOT / pages.TABLES).items():
        assert pages.source_of(ROOT / pages.PICTURES / f"{name}.png") == picture.source, (
            f"{name}: run python -m engram_lab.studies.pages draw"
        )


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The pages and tables of this checkout, to be changed."""
    for part in ("docs", "lab/reports"):
        shutil.copytree(ROOT / part, tmp_path / part)
    shutil.copy(ROOT / "README.md", tmp_path)
    return tmp_path


def test_a_changed_table_changes_its_page(checkout: Path) -> None:
    table = checkout / pages.TABLES / "conditions/conditions.csv"
    rows = table.read_text()
    assert "507,brief,0 2,overcast,259,259,0," in rows
    table.write_text(rows.replace("overcast,259,259,0,", "overcast,259,0,0,", 1))
    pages.draw(checkout)
    # 262 of 521 frames
    assert "| overcast | 50.3 |" in (checkout / "docs/evidence.md").read_text()


def test_a_map_that_a_kill_broke_is_told(checkout: Path) -> None:
    table = checkout / pages.TABLES / "kills/1.txt"
    first, *rows = table.read_text().splitlines(keepends=True)
    assert '"good": true' in first
    table.write_text("".join([first.replace('"good": true', '"good": false'), *rows]))
    pages.draw(checkout)
    assert "49 of 50 maps were sound" in (checkout / "docs/evidence.md").read_text()


def test_a_changed_table_changes_its_picture(checkout: Path) -> None:
    table = checkout / pages.TABLES / "fleet/sessions.csv"
    head, first, *rows = table.read_text().splitlines(keepends=True)
    table.write_text("".join([head, *rows, first]))
    picture = checkout / pages.PICTURES / "papers_merge.png"
    assert pages.source_of(picture) != content_of(table)
    pages.draw(checkout)
    assert pages.source_of(picture) == content_of(table)


def test_a_picture_that_is_not_there_is_drawn(checkout: Path) -> None:
    drawn = checkout / pages.PICTURES / "ranking.png"
    drawn.unlink()
    pages.draw(checkout)
    assert pages.source_of(drawn) == pages.pictures(checkout / pages.TABLES)["ranking"].source


def test_the_made_road_shows_what_the_page_of_ranking_says() -> None:
    first = {policy: [one.drive for one in order_by_policy(policy)[:3]] for policy in POLICIES}
    assert first["distance"][0] == "in the sun"  # which failed twice
    assert set(first["path"]) == {"in rain"}
    assert first["recall"][:2] == ["in rain", "at night"]


def test_an_older_version_is_said_and_is_not_released(checkout: Path, monkeypatch) -> None:
    manifest = checkout / pages.TABLES / "real-images" / MANIFEST
    today = replace(Manifest.now("real-images"), ran=1)
    for method, older in ((today.method, False), (today.method - 1, True)):
        manifest.write_text(json.dumps(evidence.to_dict(replace(today, method=method))))
        pages.draw(checkout)
        said = f"*Of method version {method}: older than this program.*"
        assert (said in (checkout / "README.md").read_text()) is older
        found = "\n".join(pages.outdated(checkout))
        assert ("README.md: real-images-in-short is of method" in found) is older


def test_what_was_not_measured_is_said_and_is_not_released(checkout: Path) -> None:
    shutil.rmtree(checkout / pages.TABLES / "budgets", ignore_errors=True)
    pages.draw(checkout)
    said = "*Not measured yet: `engram lab evaluate all --only budgets`.*"
    assert said in (checkout / "docs/ranking.md").read_text()
    assert "docs/ranking.md: budgets was not measured" in list(pages.outdated(checkout))


def test_figures_by_hand_are_not_released(checkout: Path) -> None:
    readme = checkout / "README.md"
    plain = readme.read_text()
    said = "README.md: the figures of scale are copied by hand"
    readme.write_text(f"{plain}\n<!-- by hand: kills, scale -->\n")
    assert said in list(pages.outdated(checkout))
    readme.write_text(plain)
    assert said not in list(pages.outdated(checkout))


def test_done_studies_are_kept_with_their_manifest(checkout: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    folder = results / "real-images"
    folder.mkdir(parents=True)
    evidence._write(folder, replace(Manifest.now("real-images"), ran=1, seconds=77.0))
    shutil.copy(ROOT / pages.TABLES / "real-images/figures.json", folder)
    assert pages.keep(results, checkout) == ["real-images"]
    assert read_manifest(checkout / pages.TABLES / "real-images").seconds == 77.0


def test_a_figure_that_is_missing_is_named(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    path.write_text(json.dumps({"odometry: x": [{"name": "rotation", "value": 1.0}]}))
    found = pages.Figures(path)
    assert found.value("odometry", "rotation") == 1.0
    with pytest.raises(InputError, match="no figure 'drift'"):
        found.value("odometry", "drift")


def _swept(policy: str, lanes: str, drives: str, missed: float) -> dict[str, str]:
    """A pooled row of a ranking study."""
    of = {
        "rounds": "1", "T": "10", "radius": "search", "mode": "memo", "fold": "all", "paths": "all",
        "policy": policy, "lanes": lanes, "map_sessions": drives,
    }  # fmt: skip
    shares = {"": missed, "_low": missed / 2, "_high": 2 * missed}
    return of | {
        f"{measure}{end}": str(value)
        for measure in paper_figures.MEASURES
        for end, value in shares.items()
    }


@pytest.mark.parametrize(
    ("draw", "varies"), [(paper_figures.lanes, "lanes"), (paper_figures.growth, "map_sessions")]
)
def test_curves_show_each_policy_in_per_cent_with_none_on_the_axis(draw, varies) -> None:
    rows = [
        _swept(policy, "2", "", share) | {"lanes": "2", varies: count}
        for policy, shares in {"distance": (0.4, 0.1), "recall": (0.04, 0.0)}.items()
        for count, share in zip(("2", "4"), shares, strict=True)
    ]
    figure = draw(rows, rows)
    assert len(figure.axes) == 4
    for axes in figure.axes:
        shown = {one.get_label(): one.lines[0].get_ydata().tolist() for one in axes.containers}
        assert shown["Γ(distance)"] == pytest.approx([40, 10])
        assert shown["recall"] == pytest.approx([4, 0])
        assert axes.get_ylim()[0] < 0


def test_ranking_on_wet_roads_is_pooled_apart_by_metres_driven(tmp_path: Path) -> None:
    drives = {
        "000-0901T0900-overcast-wildcat": ("100", "0.1"),
        "004-0905T1300-overcast-wildcat": ("300", "0.02"),
        "010-0911T1100-rain-wildcat": ("200", "0.5"),
    }
    rows = [
        _swept(policy, lanes, "", 0.0)
        | {"fold": "0", "drive": drive, "driven_m": driven, "share_not_localised": missed}
        for policy in ("distance", "path", "recall")
        for lanes in ("1", "2", "4")
        for drive, (driven, missed) in drives.items()
    ]
    (tmp_path / "ranking-wet").mkdir()
    write_csv(tmp_path / "ranking-wet/sessions.csv", rows)
    table = [one for one in pages.ranking_wet(tmp_path) if one.startswith("| 2 dry | `distance`")]
    # (100 m · 10 % + 300 m · 2 %) / 400 m; its interval is that of the two drives
    assert table == [f"| 2 dry | `distance` | {' | '.join(['0.00; 4.00 (2.00 … 10.00)'] * 3)} |"]
    (wet,) = [one for one in pages.ranking_wet(tmp_path) if one.startswith("| 1 in rain")]
    assert wet.count("0.00; 50.00 (50.00 … 50.00)") == 3
