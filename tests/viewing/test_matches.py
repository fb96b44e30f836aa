"""Pictures of matches: both images whole, named, in the size of the live one."""

from __future__ import annotations

import re
from dataclasses import replace
from uuid import UUID

import numpy as np
import pytest
from tests.builders import World, see

from engram.frontend.frame import BRIEF
from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.acceptance import AcceptanceConfig, Prediction, Rule, Spread
from engram.localiser.attempts import Candidate, Outcome
from engram.localiser.confidence import Standing
from engram.localiser.fixes import MatchRule
from engram.viewing.matches import refusal
from engram.viewing.pictures import match_picture, with_caption


@pytest.mark.parametrize(
    ("size", "shape"), [((100, 300), (100 + 8 + 100, 300, 3)), ((100, 120), (100, 248, 3))]
)
def test_wide_images_lie_above_each_other_and_others_side_by_side(
    size: tuple[int, int], shape: tuple[int, int, int]
) -> None:
    live = np.full(size, 90, np.uint8)
    node = np.full((20, 40), 40, np.uint8)
    none = np.zeros((0, 2), np.float32)
    picture = match_picture(node, live, none, none, ("map", "drive"))
    assert picture.shape == shape
    assert (picture[size[0] // 2, 60] == 40).all()
    assert (picture[shape[0] - size[0] // 2, -10] == 90).all()


def test_every_inlier_is_a_point_and_few_are_joined() -> None:
    live = np.zeros((400, 300), np.uint8)
    rows, columns = np.mgrid[30:390:20, 60:290:20]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float32)
    picture = match_picture(live, live, pixels / (300, 400), pixels, ("", ""))
    centres = picture[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    assert (centres.max(axis=1) > 100).all()
    gap = picture[40:380, 301:307].max(axis=(1, 2))
    crossings = np.count_nonzero(np.diff((gap > 50).astype(int)) == 1)
    assert 1 <= crossings <= 12


def test_a_small_live_image_is_enlarged_with_its_points() -> None:
    node, live = np.zeros((200, 240), np.uint8), np.zeros((50, 60), np.uint8)
    pixel = np.array([[30.0, 25.0]], np.float32)
    picture = match_picture(node, live, pixel / (60, 50), pixel, ("", ""))
    assert picture.shape == (200, 240 + 8 + 240, 3)
    assert picture[100, 120].max() > 100
    assert picture[100, 240 + 8 + 120].max() > 100


def test_a_long_caption_takes_several_lines() -> None:
    picture = np.zeros((40, 200, 3), np.uint8)
    short, long = (with_caption(picture, "turned 5° → " * count) for count in (1, 8))
    assert short.shape[1] == long.shape[1] == 200
    assert long.shape[0] > short.shape[0] > 40


_NODE = NodeId(UUID(int=2))
_LIVE = see(World(40.0), World(40.0).pose_at(5.0), 1)
_NEAR = Prediction(SE3.identity(), 0.1, 0.01)
_FAR = Prediction(SE3(np.eye(3), np.array([0.0, 0.0, 6.0])), 0.1, 0.01)
_CONFIRMED, _LATE = Standing(20, 0.0, 80.0), Standing(20, 4.0, 80.0)
_CANDIDATES = {
    "lost": Candidate(0, _NODE, None, guided=False, row=None),
    "lost for long": Candidate(0, _NODE, None, guided=False, row=None, lost_long=True),
    "confirmed": Candidate(0, _NODE, _NEAR, guided=True, row=0, standing=_CONFIRMED),
    "missed": Candidate(0, _NODE, _NEAR, guided=True, row=0, standing=_LATE),
    "doubted": Candidate(0, _NODE, _NEAR, guided=True, row=0, standing=_LATE, doubted=True),
    "supplied": Candidate(0, _NODE, _NEAR, guided=True, row=0),
    "elsewhere": Candidate(0, _NODE, _FAR, guided=True, row=0, standing=_CONFIRMED),
}
_KEYS = ("min_confidence", "min_confidence_told", "min_confidence_lost", "sure_confidence")
_LIMITS = {
    "lost": {"5.39 for a lost robot"},
    "lost for long": {"7.01 for a lost robot"},
    "confirmed": {"4.25 where a match is expected"},
    "missed": {"4.25 where a match is expected"},
    "doubted": {"4.25 where a match is expected", "5.39 for a lost robot"},
    "supplied": {"4.74 near an unconfirmed position"},
    "elsewhere": {"contradicts where the robot is expected"},
}
_OTHER = "another match of the frame is nearer to where the robot is expected"


def _judged(
    candidate: Candidate, inliers: int, spread: Spread, config: AcceptanceConfig
) -> Outcome:
    rows = np.arange(inliers, dtype=np.int32)
    match = Match(SE3.identity(), 1e-4 * np.eye(6), inliers, rows, rows)
    accepted, waits, sure, evidence = MatchRule(config).verdict(
        _LIVE, candidate, match, lambda: spread
    )
    return Outcome(candidate, 0, match, accepted, waits, confidence=sure, evidence=evidence)


@pytest.mark.parametrize("name", _CANDIDATES)
def test_a_refused_match_names_the_limit_that_refused_it(name: str) -> None:
    """As the rule itself has it: with that limit a little below the match is accepted."""
    config, candidate, said = AcceptanceConfig(), _CANDIDATES[name], set[str]()
    for inliers in range(5, 300, 5):
        for spread in (Spread(0.5, 0.9, 10.0), Spread(0.2, 0.08, 10.0)):
            outcome = _judged(candidate, inliers, spread, config)
            why = refusal(outcome, BRIEF, config)
            assert outcome.accepted == (why == _OTHER)
            found = re.fullmatch(r"confidence (-?[\d.]+), limit ([\d.]+) (.+)", why)
            if found is None:
                said.add(re.sub(r"\d+", "N", why))
                continue
            confidence, limit = float(found[1]), float(found[2])
            assert confidence < limit
            assert 0 <= outcome.confidence - confidence <= 0.01 or candidate.doubted
            lower = replace(
                config, **{key: min(getattr(config, key), max(confidence, 0.0)) for key in _KEYS}
            )
            assert confidence < 0 or _judged(candidate, inliers, spread, lower).accepted
            said.add(f"{found[2]} {found[3]}")
    said -= {"N inliers, limit N", _OTHER}
    assert said
    assert said <= _LIMITS[name]


def test_a_refused_match_says_so_by_the_rule_of_inliers_and_without_a_pose() -> None:
    config, wide = AcceptanceConfig(rule=Rule.INLIERS), Spread(0.5, 0.9, 10.0)
    lost = _judged(_CANDIDATES["lost"], 40, wide, config)
    near = _judged(_CANDIDATES["confirmed"], 15, wide, config)
    assert refusal(lost, BRIEF, config) == "40 inliers, limit 60"
    assert refusal(near, BRIEF, config) == "15 inliers, limit 20"
    assert refusal(replace(near, evidence=None), BRIEF, config).startswith("no pose")
    sure = _judged(_CANDIDATES["confirmed"], 100, wide, AcceptanceConfig())
    doubted = refusal(replace(sure, accepted=False), BRIEF, AcceptanceConfig(), doubted=True)
    assert "less than is usual here" in doubted
