"""Builds of two versions alternate, and their ratios are of this version over the other."""

from pathlib import Path

import pytest

from engram_lab.checks import builds


def test_sides_alternate_and_ratios_are_ours_over_theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    order = []

    def built_s(checkout: Path, logs: list[Path]) -> tuple[float, float]:
        order.append("here" if checkout is builds.HERE else "there")
        return (1.0, 3.0) if checkout is builds.HERE else (2.0, 4.0)

    monkeypatch.setattr(builds, "built_s", built_s)
    figures = {one.name: one.value for one in builds.compared(Path("there"), [], 2)}
    assert order == ["here", "there", "there", "here"]
    assert figures["ratio, processor, median"] == pytest.approx(0.5)
    assert figures["ratio, clock, median"] == pytest.approx(0.75)
