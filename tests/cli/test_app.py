"""What the program does with errors that no verb foresees."""

import pytest

from engram import _core
from engram.cli import app


def test_a_core_of_another_version_is_told_in_one_line(engram, monkeypatch) -> None:
    def stale(**_: object) -> None:
        _core.a_kernel_that_is_not_built()

    monkeypatch.setattr(app, "app", stale)
    ran = engram("info", "map.engram")
    assert ran.status == 2
    assert "the compiled core is older" in ran.err
    assert "a_kernel_that_is_not_built" in ran.err


def test_other_faults_of_ours_are_not_hidden(engram, monkeypatch) -> None:
    def faulty(**_: object) -> None:
        object().nothing  # noqa: B018

    monkeypatch.setattr(app, "app", faulty)
    with pytest.raises(AttributeError):
        engram("info", "map.engram")


def test_a_mistyped_folder_does_not_become_a_centre(engram, tmp_path) -> None:
    ran = engram("centre", "jobs", tmp_path / "twon")
    assert ran.status == 2
    assert "there is no centre" in ran.err
    assert not (tmp_path / "twon").exists()
