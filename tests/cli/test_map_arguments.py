"""How maps are named on the command line: by files."""

from __future__ import annotations

from pathlib import Path

import pytest

ADDRESS = "postgresql://somebody:secret@localhost/fleet"


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
    assert "engram centre" in " ".join(ran.err.split())
    assert "secret" not in ran.err
    assert list(tmp_path.iterdir()) == []
