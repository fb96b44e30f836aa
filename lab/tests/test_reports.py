"""The reports: an abstract first, links that lead somewhere, figures that are there."""

import re
from pathlib import Path

import pytest

REPORTS = sorted((Path(__file__).parents[1] / "reports").glob("*.md"))


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
