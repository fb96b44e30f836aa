"""The memo of matches: what it keeps is what would be made."""

from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from tests.builders import World, drive

from engram.frontend.matching import MatcherConfig
from engram.graph.model import NodeId, SessionId, node_id
from engram.localiser.attempts import Lanes
from engram_lab.studies.lockstep import MatchMemo

WORLD = World(20.0)
CONFIG = MatcherConfig()
LIVE = SessionId(UUID(int=7))


class Frames:
    """Frames in memory, counting how often they are asked for."""

    def __init__(self) -> None:
        self.asked = 0
        seen = [*drive(WORLD, np.arange(0.0, 6.0, 2.0)), *drive(WORLD, np.arange(0.0, 6.0, 2.0), 1)]
        self.nodes = {NodeId(UUID(int=k)): one.frame for k, one in enumerate(seen)}

    def frame(self, node):
        self.asked += 1
        return self.nodes[node]

    def prefetch(self, nodes) -> None:
        raise AssertionError("a memo reads nothing ahead")


@pytest.fixture
def frames() -> Frames:
    return Frames()


def live_frames():
    return [one.frame for one in drive(WORLD, np.arange(0.3, 4.0, 1.5), seed=3, start_ns=10**15)]


def memo_of(frames: Frames, path: Path, matcher_hash: str = "a") -> MatchMemo:
    return MatchMemo(Lanes(frames, CONFIG), path, matcher_hash)


def everything(matcher, frames: Frames) -> list:
    return [
        matcher.match(live, node_id(LIVE, live.stamp_ns), node, None)
        for live in live_frames()
        for node in frames.nodes
    ]


def assert_same(found, wanted) -> None:
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        assert one.inliers == other.inliers
        assert (one.reference_from_live is None) == (other.reference_from_live is None)
        if other.reference_from_live is not None:
            assert (one.reference_from_live.matrix() == other.reference_from_live.matrix()).all()
            assert (one.covariance == other.covariance).all()


def test_what_is_kept_is_to_the_bit_what_would_be_made(frames: Frames, tmp_path: Path) -> None:
    wanted = everything(Lanes(frames, CONFIG), frames)
    assert any(one.inliers > 20 for one in wanted)
    assert any(one.inliers == 0 for one in wanted)
    memo = memo_of(frames, tmp_path / "memo.npz")
    assert_same(everything(memo, frames), wanted)
    memo.save()
    frames.asked = 0
    again = memo_of(frames, tmp_path / "memo.npz")
    assert again.known == len(wanted)
    assert_same(everything(again, frames), wanted)
    assert frames.asked == again.made == 0


def test_an_attempt_is_made_once(frames: Frames, tmp_path: Path) -> None:
    memo = memo_of(frames, tmp_path / "memo.npz")
    everything(memo, frames)
    made = memo.made
    everything(memo, frames)
    assert memo.made == made == len(frames.nodes) * len(live_frames())


@pytest.mark.parametrize("damage", ["other matcher", "cut short", "no archive"])
def test_a_memo_that_does_not_fit_counts_as_empty(
    frames: Frames, tmp_path: Path, damage: str
) -> None:
    path = tmp_path / "memo.npz"
    memo = memo_of(frames, path)
    everything(memo, frames)
    memo.save()
    if damage == "cut short":
        path.write_bytes(path.read_bytes()[:-100])
    elif damage == "no archive":
        path.write_bytes(b"nothing of the kind")
    again = memo_of(frames, path, "b" if damage == "other matcher" else "a")
    assert again.known == 0
    assert_same(everything(again, frames), everything(Lanes(frames, CONFIG), frames))


def test_the_spread_of_inliers_is_known_too(frames: Frames, tmp_path: Path) -> None:
    matcher, memo = Lanes(frames, CONFIG), memo_of(frames, tmp_path / "memo.npz")
    live, node = live_frames()[0], next(iter(frames.nodes))
    live_id = node_id(LIVE, live.stamp_ns)
    match = matcher.match(live, live_id, node, None)
    kept = memo.match(live, live_id, node, None)
    spread = matcher.spread(live, live_id, node, match)
    assert memo.spread(live, live_id, node, kept) == spread
    assert min(spread.image, spread.height) > 0
