"""Counts in words."""

from __future__ import annotations

import pytest

from engram.counts import counted
from engram.fleet.merge.report import MergeReport
from engram.maps.history import log_text


@pytest.mark.parametrize(
    ("number", "thing", "said"),
    [
        (1, "node", "1 node"),
        (0, "node", "0 nodes"),
        (12, "path entry", "12 path entries"),
        (2, "match", "2 matches"),
        (1, "match", "1 match"),
    ],
)
def test_one_thing_stands_in_the_singular(number: int, thing: str, said: str) -> None:
    assert counted(number, thing) == said


def test_reports_count_one_thing_as_one() -> None:
    report = MergeReport("r1.engram", "", ["r1"], 1, changed=True, taken=1, sessions=1)
    report.components, report.attempts = 1, 2
    assert "1 node added" in report.text()
    assert "1 new session, 0 path entries, 2 attempts" in report.text()
    assert "1 component" in report.text()
    counts = {"nodes": 1.0, "edges": 2.0, "omissions": 1.0, "vocabularies": 2.0}
    said = dict.fromkeys(("number", "author", "message", "when", "host", "tool_version"), "")
    text = log_text({**said, "tags": [], "contents": counts})
    assert "1 node, 2 edges, 1 node omitted, 2 vocabularies" in text
