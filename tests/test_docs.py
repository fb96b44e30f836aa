"""What the documents show works as shown."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import typer

import engram
from engram.cli.app import app
from engram.robot import RobotOptions, map_drive, open_drive

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def shown_commands() -> Iterator[tuple[str, list[str]]]:
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        for block in re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S):
            for line in block.splitlines():
                if line.strip().startswith("engram "):
                    yield page.name, shlex.split(line.split("#")[0])


@pytest.mark.parametrize(("page", "words"), list(shown_commands()))
def test_every_command_shown_is_a_verb_with_these_options(page: str, words: list[str]) -> None:
    verbs = typer.main.get_command(app).commands
    assert words[1] in verbs, f"{page}: engram {words[1]}"
    verb = verbs[words[1]]
    for word in words[2:]:
        if hasattr(verb, "commands"):
            assert word in verb.commands, f"{page}: {' '.join(words)}"
            verb = verb.commands[word]
    known = {
        option
        for parameter in verb.params
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    assert {word for word in words if word.startswith("--")} <= known


def test_every_link_to_a_file_leads_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def sections_of_the_method() -> dict[str, str]:
    """Number → what stands below the heading."""
    parts = re.split(r"^## (\d+)\. .*$", (ROOT / "docs/method.md").read_text(), flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def cited_sections(text: str) -> Iterator[tuple[str, str]]:
    """Section and item of citations such as "SPEC §3.6, §4", "SPEC §2.1–2.3", "SPEC §7 MERGE 3"."""
    for numbers, merge in re.findall(
        r"SPEC §(\d[\d.]*(?:(?:, §|–)\d[\d.]*)*)(?: MERGE (\d))?", text
    ):
        for section, item in re.findall(r"(\d+)(?:\.(\d+))?", numbers):
            yield section, item or merge


def test_every_section_that_is_cited_is_in_the_method() -> None:
    sections = sections_of_the_method()
    assert "".join(sections) == "123456789"
    cited = [
        (path, section, item)
        for folder in ("src", "lab/src", "tests")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".hpp", ".cpp"} and path != Path(__file__)
        for section, item in cited_sections(path.read_text())
    ]
    assert len(cited) > 100  # the pattern still meets them
    for path, section, item in cited:
        where = f"{path.relative_to(ROOT)}: SPEC §{section}"
        assert section in sections, where
        assert not item or re.search(rf"^{item}\. ", sections[section], re.M), f"{where}.{item}"


def test_every_class_that_the_architecture_names_is_there() -> None:
    source = "\n".join(path.read_text() for path in (ROOT / "src/engram").rglob("*.py"))
    page = (ROOT / "docs/architecture.md").read_text()
    named = re.findall(r"`([A-Z]\w*[a-z]\w*)(?:\.(\w+))?`", page)
    assert ("FrameReader", "hold") in named
    for name, member in named:
        assert re.search(rf"^class {name}\b", source, re.M), name
        assert re.search(rf"^    (?:def )?{member}\b", source, re.M), f"{name}.{member}"


def test_the_example_of_the_readme_runs(
    street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    map_drive(tmp_path / "town.engram", open_drive(street), engram.Settings(), RobotOptions())
    block = re.search(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    assert block is not None
    dark = np.zeros((370, 1226), dtype=np.uint8)
    pairs = [(number * 50_000_000, dark, dark) for number in range(2)]
    names: dict[str, object] = {"my_camera": lambda: pairs}
    exec(compile(block.group(1), "README.md", "exec"), names)
    found = names["found"]
    assert isinstance(found, engram.Localisation)
    assert found.status is engram.LocalisationStatus.NO_ODOMETRY


def test_a_robot_that_hands_in_pairs_one_by_one_is_localised(street: Path, tmp_path: Path) -> None:
    path = tmp_path / "town.engram"
    map_drive(path, open_drive(street), engram.Settings(), RobotOptions())
    pairs = list(open_drive(street))
    with engram.open_map(path) as town, town.robot(pairs[0].camera, lanes=1) as robot:
        found = [robot.localise(pair, deadline_ms=1000) for pair in pairs]
        # A deadline that is over before the first attempt leaves the robot to its odometry.
        hurried = robot.localise(
            engram.StereoPair(
                pairs[-1].stamp_ns + 10**8, pairs[-1].left, pairs[-1].right, pairs[-1].camera
            ),
            deadline_ms=1e-6,
        )
    assert all(one.status is engram.LocalisationStatus.LOCALISED for one in found)
    assert hurried.status is engram.LocalisationStatus.DEAD_RECKONING
    assert hurried.attempts == 0
    assert hurried.node_from_live is None
    assert hurried.position is not None
