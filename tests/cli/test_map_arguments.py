"""How maps are named on the command line: files, and as of which revision."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer

from engram.cli.app import app

HISTORY = Path(__file__).parents[2] / "docs" / "history.md"
ADDRESS = "postgresql://somebody:secret@localhost/fleet"


def test_the_verbs_that_take_a_revision_are_those_that_the_documents_name() -> None:
    verbs = typer.main.get_command(app).commands
    taking = {name for name, verb in verbs.items() if any(p.name == "at" for p in verb.params)}
    sentence = r"`--at` shows a map as of a\s+revision:(.*?)take it"
    named = re.search(sentence, HISTORY.read_text(), re.S)
    assert named is not None
    assert {words.split()[0] for words in re.findall(r"`([^`]+)`", named[1])} == taking


@pytest.mark.parametrize(
    "words",
    [
        ("info", ADDRESS),
        ("check", ADDRESS),
        ("merge", ADDRESS, "r1.engram", "--dry-run"),
        ("merge", "c.engram", "r1.engram", ADDRESS),
        ("download", ADDRESS, "r1.engram"),
        ("download", "c.engram", ADDRESS),
        ("map", ADDRESS, "drive"),
        ("build", ADDRESS, "drive"),
    ],
)
def test_addresses_of_databases_are_refused_and_never_taken_for_files(
    engram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = engram(*words)
    assert ran.status == 2
    assert "PostgreSQL" in ran.err
    assert "secret" not in ran.err
    assert list(tmp_path.iterdir()) == []
