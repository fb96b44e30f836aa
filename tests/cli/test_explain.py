"""`engram localise --explain`: the reasons that it gives are those by which it ranked."""

from __future__ import annotations

from pathlib import Path

import pytest

from engram.ranking.policies import policy_names


@pytest.mark.parametrize("policy", sorted({*policy_names()} - {"oracle"}))
def test_every_policy_is_explained(engram, street: Path, mapped_street: Path, policy: str) -> None:
    ran = engram("localise", mapped_street, street, "--explain", 6, "--ranking", policy, "--json")
    assert ran.status == 0
    assert "NaN" not in ran.out, "which is no JSON"
    found = ran.json
    assert (found["frame"], found["ranking"], found["status"]) == (6, policy, "localised")
    candidates = found["candidates"]
    assert len(candidates) > 3
    # The frame stands beside the node that was saved from it or from its neighbour.
    assert any(one["would_match"] and one["inliers"] > 100 for one in candidates)
    attempted = [one["attempted"] for one in candidates]
    assert attempted == sorted(attempted, reverse=True), "the best are attempted first"
    assert 1 <= sum(attempted) <= 4
    for one in candidates:
        assert set(one["terms"]) == set(found["meaning"])
        assert 0 <= one["success_rate"] <= 1
    if policy == "distance":
        distances = [one["distance_m"] for one in candidates]
        assert distances == sorted(distances)
    if policy.startswith(("path", "recall", "bandit", "bag", "time", "collaborative")):
        assert candidates[0]["terms"]
    assert bool(found["rule"]) is (policy != "random")


def test_text_names_terms_and_outcomes(engram, street: Path, mapped_street: Path) -> None:
    ran = engram("localise", mapped_street, street, "--explain", 6, "--ranking", "recall")
    assert ran.status == 0
    assert "frame 6: localised" in ran.out
    assert "past drives: how past drives fared" in ran.out
    assert "order: greatest sum first" in ran.out
    assert "matched," in ran.out


def test_a_match_refused_as_a_lookalike_is_told(
    engram, street: Path, mapped_street: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ("localise", mapped_street, street, "--explain", 6)
    assert engram(*asked, "--json").json["refused"] is False
    monkeypatch.setattr("engram.localiser.yardstick.Likeness.alike", lambda _: 3.0)
    found = engram(*asked, "--json").json
    assert found["refused"] is True
    assert found["status"] != "localised"
    assert "street of equal fronts" in engram(*asked).out


def test_a_frame_without_candidates_is_told_as_such(
    engram, street: Path, mapped_street: Path
) -> None:
    ran = engram("localise", mapped_street, street, "--explain", 0)
    assert ran.status == 0
    assert "nothing to rank" in ran.out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--explain", 99), "no frame 99"),
        (("--explain", 3, "--ranking", "oracle"), "oracle"),
        (("--explain", 3, "--ranking", "nearest"), "no ranking policy"),
        (("--explain", 3, "--rate", 20), "leave out --rate"),
    ],
)
def test_what_cannot_be_explained_is_refused(
    engram, street: Path, mapped_street: Path, arguments: tuple[object, ...], complaint: str
) -> None:
    ran = engram("localise", mapped_street, street, *arguments)
    assert ran.status == 2
    assert complaint in ran.err
