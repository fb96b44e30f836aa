"""What `engram evaluate` refuses, and how it takes its arguments."""

from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--policies", "distance", "--redo", "path"), "--redo 'path': is not among the policies"),
        (("--redo", "nonsense"), "--redo 'nonsense': is not among the policies"),
        (("--redo", "path", "--report-only"), "--report-only runs nothing"),
        (("--policies", "distanec"), "no ranking policy 'distanec'"),
        (("--only-folds", "5"), "5"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_run(
    engram, tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    ran = engram("evaluate", "ranking", "hamlet", *options, "--work", tmp_path / "work")
    assert ran.status == 2
    assert said in ran.err
    assert not (tmp_path / "work").exists()


def test_a_campaigns_name_is_the_campaign_though_a_folder_has_it_too(
    engram, tmp_path: Path, monkeypatch
) -> None:
    (tmp_path / "hamlet").mkdir()
    monkeypatch.chdir(tmp_path)
    ran = engram("evaluate", "ranking", "hamlet", "--campaigns", tmp_path / "none")
    assert ran.status == 2
    assert "sessions are not rendered" in ran.err
    other = engram("evaluate", "ranking", "hamlet/", "--campaigns", tmp_path / "none")
    assert "is no frame log" in other.err
