"""The reports: short, of a named version, an abstract first; links and intervals are right."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from engram_lab.intervals import Resamples, SessionSums, difference
from engram_lab.studies.paper_figures import read, sessions_of

REPORTS = sorted((Path(__file__).parents[1] / "reports").glob("*.md"))


# A reference, as long as the method: docstrings cite its sections.
REFERENCE = {"method"}
SHORT = [page for page in REPORTS if page.stem not in REFERENCE]


@pytest.mark.parametrize("page", SHORT, ids=lambda page: page.stem)
def test_a_report_has_at_most_600_words(page: Path) -> None:
    assert len(page.read_text().split()) <= 600  # tables included, as `wc -w` counts


@pytest.mark.parametrize("page", REPORTS, ids=lambda page: page.stem)
def test_a_report_first_names_the_method_and_the_world_of_its_figures(page: Path) -> None:
    line = page.read_text().split("\n\n")[1].splitlines()[0]
    assert re.search(r"\bmethods? \d", line, re.IGNORECASE)
    assert re.search(r"\bworlds? \d", line, re.IGNORECASE)


@pytest.mark.parametrize("page", REPORTS, ids=lambda page: page.stem)
def test_a_report_is_dated_and_begins_with_an_abstract(page: Path) -> None:
    title, date, abstract = (part for part in page.read_text().split("\n\n", 3)[:3])
    assert title.startswith("# ")
    assert re.match(r"\*\w+ 20\d\d\.", date)
    assert abstract == "## Abstract"


@pytest.mark.parametrize("page", REPORTS, ids=lambda page: page.stem)
def test_every_link_to_a_file_leads_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#:]+)\)", page.read_text())
    assert [one for one in targets if not (page.parent / one).exists()] == []


FOLDER = Path(__file__).parents[1] / "reports"
# "+0.72 (−0.32 … +2.30) points"
POINTS = re.compile(r"([+−][\d.]+) \(([+−][\d.]+) … ([+−][\d.]+)\) points; \d+ drives")
PAIRS = {
    "`tod` against `copy`": ("held out in tod", "held out in copy"),
    "`tod+paths` against `copy`": ("held out in tod+paths", "held out in copy"),
    "`budget 1/4` against `copy`": ("held out in budget 1/4", "held out in copy"),
    "`budget 1/10` against `copy`": ("held out in budget 1/10", "held out in copy"),
    "`budget` of the bytes of `tod` against it": ("held out in budget as tod", "held out in tod"),
}


def sums(rows, drives) -> SessionSums:
    found = {(one["fold"], one["drive"]): one for one in rows}
    driven_m = np.array([float(found[one]["driven_m"]) for one in drives])
    share = np.array([float(found[one]["share_not_localised"]) for one in drives])
    return SessionSums(share * driven_m, driven_m)


@pytest.mark.parametrize("what", PAIRS)
def test_printed_intervals_are_those_of_the_kept_rows(what):
    text = (FOLDER / "fleet.md").read_text(encoding="utf-8")
    (line,) = [one for one in text.splitlines() if one.startswith(f"| {what}, route not localised")]
    printed = [tuple(float(x.replace("−", "-")) for x in one) for one in POINTS.findall(line)]
    assert len(printed) == 2
    rows = read(FOLDER / "tables/fleet/sessions.csv")
    for arm, told in zip("AB", printed, strict=True):
        ours, theirs = (sessions_of(rows, arm, "9", name) for name in PAIRS[what])
        there = {(one["fold"], one["drive"]) for one in theirs}
        drives = [key for one in ours if (key := (one["fold"], one["drive"])) in there]
        paired = difference(sums(ours, drives), sums(theirs, drives))
        found = Resamples.of(len(drives), seed=0).interval(paired)
        again = [100 * value for value in (found.estimate, found.low, found.high)]
        assert again == pytest.approx(told, abs=0.0051)
