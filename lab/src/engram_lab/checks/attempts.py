"""Right matches lost from one version to another, condition by condition, and what attempts cost.

    PYTHONPATH=BEFORE/src:lab/src python -m engram_lab.checks.attempts --write before.json
    python -m engram_lab.checks.attempts --against before.json

BEFORE is a checkout of the other version, built in place. Matches whole frames, unguided: the
places of `engram_lab.checks.eyes`, each with itself and both neighbours, and the real clips of
ENGRAM_DATA. A match is right that has the product's least inliers and a pose within 0.25 m of the
truth.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from engram.cli.screen import Bars
from engram.frontend.frame import Frame
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.se3 import SE3
from engram.monitor import Monitor, write_whole
from engram_lab.checks import eyes_real
from engram_lab.checks.eyes import LEAST_INLIERS, PAIRS, TOWNS, WITHIN_M, between, error_m
from engram_lab.eyes import judged_scene
from engram_lab.programs import command_line

Pair = tuple[Frame, Frame, SE3]

HEADER = (
    "| condition | attempts | right before | after | lost | found anew | net lost | wrong before "
    "| after | ms before | after |\n|" + " --- |" * 11
)


@dataclass(frozen=True, slots=True)
class Judged:
    """One condition.

    Attributes:
        what: the condition.
        right: of each attempt, whether it is.
        wrong: how many have enough inliers, and a pose further off.
        each_ms: processor time of an attempt.
    """

    what: str
    right: list[bool]
    wrong: int
    each_ms: float

    def row(self, before: Judged) -> str:
        """A line of the Markdown table."""
        ours, theirs = np.array(self.right), np.array(before.right)
        net = 100 * (theirs.sum() - ours.sum()) / max(theirs.sum(), 1)
        return (
            f"| {self.what} | {len(ours)} | {theirs.sum()} | {ours.sum()} "
            f"| {(theirs & ~ours).sum()} | {(ours & ~theirs).sum()} | {net:+.1f} % "
            f"| {before.wrong} | {self.wrong} | {before.each_ms:.3f} | {self.each_ms:.3f} |"
        )


def judged(what: str, pairs: Sequence[Pair], seeds: int) -> Judged:
    """Matches all pairs, with so many seeds of the random draws."""
    config, right, wrong, spent_s = MatcherConfig(), [], 0, 0.0
    for seed in range(seeds):
        began = time.thread_time()
        matches = [match_frames(a, b, config, seed) for a, b, _ in pairs]
        spent_s += time.thread_time() - began
        for match, (_, _, truth) in zip(matches, pairs, strict=True):
            found, good = match.inliers >= LEAST_INLIERS, error_m(match, truth) < WITHIN_M
            right.append(bool(found and good))
            wrong += found and not good
    return Judged(what, right, wrong, 1e3 * spent_s / max(len(right), 1))


def of_towns(frontend: Frontend, monitor: Monitor) -> Iterator[tuple[str, list[Pair]]]:
    """Places of the judged towns under two lights, with themselves and their neighbours."""
    scenes = [judged_scene(seed, monitor) for seeds in TOWNS for seed in seeds]
    frames = [scene.frames(frontend) for scene in scenes]
    for a, b in PAIRS:
        pairs = []
        for scene, seen in zip(scenes, frames, strict=True):
            places = scene.left.shape[1]
            for i in range(places):
                for j in range(max(i - 1, 0), min(i + 2, places)):
                    truth = between(scene, (a, i), (b, j))
                    pairs.append((seen[a, i], seen[b, j], truth))
        yield f"{a} / {b}", pairs
    nowhere = SE3(np.eye(3), np.full(3, np.inf))
    apart = [
        (seen["morning", place], other["morning", place], nowhere)
        for seen, other in zip(frames, [*frames[1:], frames[0]], strict=True)
        for place in range(min(scene.left.shape[1] for scene in scenes))
    ]
    yield "another town", apart


def of_clips(frontend: Frontend, data: Path) -> Iterator[tuple[str, list[Pair]]]:
    """Pairs of real frames with known poses, and of different drives."""
    pairs: list[Pair] = []
    for what, some in eyes_real.posed_pairs(frontend, data):
        yield what, some
        pairs += some
    kitti = [pair for pair in pairs if pair[0].camera.width == 1226]
    euroc = [pair for pair in pairs if pair[0].camera.width != 1226]
    nowhere = SE3(np.eye(3), np.full(3, np.inf))
    both = zip(kitti, euroc, strict=False)
    yield "KITTI / EuRoC", [(a, b, nowhere) for (a, _, _), (_, b, _) in both]


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="of the random draws, each pair")
    parser.add_argument("--write", type=Path, help="of this version, for the other one")
    parser.add_argument("--against", type=Path, help="what the other version wrote")
    asked = parser.parse_args()
    frontend = Frontend(FrontendConfig(thumbnails=False))
    before = json.loads(asked.against.read_text(encoding="utf-8")) if asked.against else {}
    print(HEADER)
    after = {}
    for what, pairs in conditions(frontend, Bars()):
        now = judged(what, pairs, asked.seeds)
        after[what] = asdict(now)
        print(now.row(Judged(**before[what]) if before else now), flush=True)
    if asked.write:
        with write_whole(asked.write) as draft:
            draft.write_text(json.dumps(after), encoding="utf-8")


def conditions(frontend: Frontend, monitor: Monitor) -> Iterator[tuple[str, list[Pair]]]:
    """All of them by name."""
    yield from of_towns(frontend, monitor)
    if data := os.environ.get("ENGRAM_DATA"):
        yield from of_clips(frontend, Path(data))


if __name__ == "__main__":
    main()
