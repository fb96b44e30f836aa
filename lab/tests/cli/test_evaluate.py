"""What `engram lab evaluate` refuses, and how it takes its arguments."""

from pathlib import Path

import pytest
from tests.cli.conftest import engram

__all__ = ["engram"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--policies", "distance", "--redo", "path"), "--redo 'path': not among the policies"),
        (("--redo", "nonsense"), "--redo 'nonsense': not among the policies"),
        (("--redo", "path", "--report-only"), "--report-only runs nothing"),
        (("--policies", "distanec"), "no ranking policy 'distanec'"),
        (("--only-folds", "5"), "5"),
        (("hamlet",), "campaign 'hamlet' is given twice"),
        (("--relocaliser", "fabmapp"), "relocaliser 'fabmapp' is unknown"),
        (("--lanes", "0,-1"), "must be whole numbers from 1 on"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_run(
    engram, tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    ran = engram("lab", "evaluate", "ranking", "hamlet", *options, "--work", tmp_path / "work")
    assert ran.status == 2
    assert said in ran.err
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("hamlett", "hamlett"),
        ("hamlet@x", "the seed after @ must be a whole number"),
        ("hamlet@-1", "-1"),
    ],
)
def test_a_campaign_that_is_none_is_told_as_such(engram, tmp_path: Path, name: str, said: str):
    ran = engram("lab", "evaluate", "ranking", name, "--campaigns", tmp_path / "none")
    assert ran.status == 2
    assert said in ran.err
    assert ("whole number" in ran.err) == ("whole number" in said)


def test_a_campaigns_name_is_the_campaign_though_a_folder_has_it_too(
    engram, tmp_path: Path, monkeypatch
) -> None:
    (tmp_path / "hamlet").mkdir()
    monkeypatch.chdir(tmp_path)
    ran = engram("lab", "evaluate", "ranking", "hamlet", "--campaigns", tmp_path / "none")
    assert ran.status == 2
    assert "sessions are not rendered" in ran.err
    other = engram("lab", "evaluate", "ranking", "hamlet/", "--campaigns", tmp_path / "none")
    assert "is not a frame log" in other.err
