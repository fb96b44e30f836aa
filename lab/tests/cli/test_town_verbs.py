"""`engram lab simulate` and `engram lab bench` as their users meet them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from tests.cli.conftest import engram

__all__ = ["engram"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("bench", "--only", "warp"), "warp"),
        (("simulate", "atlantis"), "atlantis"),
        (("simulate", "hamlet", "--size", "huge"), "huge"),
        (("simulate", "hamlet", "--sessions", "9"), "not 9"),
        (("simulate", "hamlet", "--sessions", "one"), "one"),
        (("simulate", "hamlet", "--sessions", ""), "--sessions ''"),
        (("simulate", "hamlet", "--sessions", "0,"), "--sessions '0,'"),
    ],
)
def test_bad_input_is_one_clear_line_and_status_two(
    engram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], says: str
) -> None:
    monkeypatch.setenv("ENGRAM_CAMPAIGNS", str(tmp_path))
    ran = engram("lab", *arguments)
    assert ran.status == 2
    assert ran.err.startswith("engram: ")
    assert says in ran.err
    assert "Traceback" not in ran.err


def test_bench_gives_the_documented_json(engram) -> None:
    ran = engram("lab", "bench", "--only", "attempt_512,rank_path_150", "--repeats", 3, "--json")
    stages = ran.json["stages"]
    assert set(stages) == {"attempt_512", "rank_path_150"}
    for stage in stages.values():
        assert {"ms", "p99_ms", "reference_ms", "ratio"} <= set(stage)
        assert math.isfinite(stage["ms"])
    assert ran.json["machine"]
