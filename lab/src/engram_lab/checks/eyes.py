"""What each kind of features recognises: the same places under other lights, and false places.

    python -m engram_lab.checks.eyes --kinds brief,net --out results/eyes

Matches whole frames, unguided, from rendered towns that no descriptor was trained on and, where
ENGRAM_DATA names them, of real clips. A match counts if it has the kind's least inliers and its
pose is within 0.25 m of the truth. OUT.csv gets a row for each figure.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.cli.screen import Bars
from engram.frontend.features import NET, FeatureKind, detect_corners, feature_kind
from engram.frontend.frame import Frame
from engram.geometry.se3 import SE3
from engram.monitor import Monitor, write_whole
from engram.places.recognisers import FabMap, PlaceRecogniser, Signatures
from engram.places.vocabulary import default_vocabulary
from engram_lab.checks.accuracy import MIN_INLIERS, NEAR_M, PARTS, Eyes, error_m
from engram_lab.eyes import Scene, judged_scene, training_scene
from engram_lab.programs import command_line

# Parts of `checks.accuracy` that depend on the features.
REAL = ("revisits", "basin", "odometry", "cross_rig", "seasons")
PAIRS = (
    ("morning", "late afternoon"),
    ("morning", "night"),
    ("overcast", "night"),
    ("morning", "snow"),
    ("morning", "fog"),
    ("night", "rain at night"),
    ("overcast", "rain"),
    ("rain", "rain again"),
)
RECOGNISED = ("late afternoon", "night", "snow", "rain")
TOWNS = ((1, 4), (2, 301))
# Two towns that nothing else uses: random visits of a place, and places of different towns.
CALIBRATION = (207, 208)
_RANDOM, _SAME, _OTHER = 3000, 500, 6000


def kind_of(eyes: Eyes) -> FeatureKind:
    return feature_kind(eyes.frontend.config.descriptor)


@dataclass(frozen=True, slots=True)
class Row:
    """One figure of one kind."""

    where: str
    what: str
    value: float
    of: float = 100.0
    wrong: int = 0


def town_rows(eyes: Eyes, seeds: Sequence[int], monitor: Monitor) -> Iterator[Row]:
    """Places of some towns under two lights, and pairs of places of different towns."""
    scenes = [judged_scene(seed, monitor) for seed in seeds]
    frames = [scene.frames(eyes.frontend) for scene in scenes]
    where = "towns " + ", ".join(map(str, seeds))
    for a, b in PAIRS:
        right, wrong, places = 0, 0, 0
        for scene, seen in zip(scenes, frames, strict=True):
            for place in range(scene.left.shape[1]):
                match = eyes.match(seen[a, place], seen[b, place])
                off_m = error_m(match, between(scene, (a, place), (b, place)))
                places += 1
                if off_m is not None:
                    right, wrong = right + (off_m < NEAR_M), wrong + (off_m >= NEAR_M)
        yield Row(where, f"{a} / {b}", right, places, wrong)
    yield from place_rows(eyes, where, frames)
    draws = np.random.default_rng(11)
    pairs = [tuple(draws.choice(len(seeds), 2, replace=False)) for _ in range(_RANDOM)]
    falsely = sum(
        eyes.match(_any(frames[a], draws), _any(frames[b], draws)).inliers >= MIN_INLIERS
        for a, b in pairs
    )
    yield Row(where, "false accepts between the two towns", falsely, _RANDOM)


def place_rows(
    eyes: Eyes, where: str, frames: Sequence[Mapping[tuple[str, int], Frame]]
) -> Iterator[Row]:
    """Of single images of a visit, how many a recogniser finds among the morning's places."""
    vocabulary = default_vocabulary(kind_of(eyes).name)
    by_words, by_signature = FabMap(vocabulary), None
    if kind_of(eyes).name == NET:
        by_signature = Signatures(vocabulary)

    def words(frame: Frame) -> NDArray[np.int32]:
        return vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)

    yield from _recognised(by_words, words, f"{where}, by words", frames)
    if by_signature is not None:
        yield from _recognised(
            by_signature, by_signature.signature, f"{where}, by signature", frames
        )
    else:
        for name in RECOGNISED:
            of = sum(len(_visit(seen, name)) for seen in frames)
            yield Row(f"{where}, by signature", _title(name), 0, of)


def _recognised(
    recogniser: PlaceRecogniser,
    shown: Callable[[Frame], NDArray[np.int32]],
    where: str,
    frames: Sequence[Mapping[tuple[str, int], Frame]],
) -> Iterator[Row]:
    at = []
    for town, seen in enumerate(frames):
        for place, frame in _visit(seen, "morning"):
            recogniser.add(shown(frame))
            at.append((town, place))
    for name in RECOGNISED:
        right = of = 0
        for town, seen in enumerate(frames):
            for place, frame in _visit(seen, name):
                best = recogniser.recognise(shown(frame), 1).places
                right += any(at[k][0] == town and abs(at[k][1] - place) <= 1 for k in best)
                of += 1
        yield Row(where, _title(name), right, of)


def _title(visit: str) -> str:
    return f"recognised at once within 5 m: {visit} / morning"


def _visit(seen: Mapping[tuple[str, int], Frame], name: str) -> list[tuple[int, Frame]]:
    return [(key[1], seen[key]) for key in sorted(seen) if key[0] == name]


def between(scene: Scene, a: tuple[str, int], b: tuple[str, int]) -> SE3:
    """True a_from_b."""
    world_from_a, world_from_b = (
        scene.world_from_cam[scene.visits.index(visit), place] for visit, place in (a, b)
    )
    return SE3.from_matrix(np.linalg.inv(world_from_a) @ world_from_b)


def _any(frames: Mapping[tuple[str, int], Frame], draws: np.random.Generator) -> Frame:
    every = sorted(frames)
    return frames[every[int(draws.integers(len(every)))]]


def calibration_rows(eyes: Eyes, monitor: Monitor) -> Iterator[Row]:
    """Right matches at equal false accepts, by the number of inliers."""
    scenes = [training_scene(seed, monitor=monitor) for seed in CALIBRATION]
    frames = [scene.frames(eyes.frontend) for scene in scenes]
    draws, right = np.random.default_rng(1), []
    for _ in range(_SAME):
        town = int(draws.integers(2))
        scene = scenes[town]
        a, b = (scene.visits[int(k)] for k in draws.choice(len(scene.visits), 2, replace=False))
        place = int(draws.integers(scene.left.shape[1]))
        match = eyes.match(frames[town][a, place], frames[town][b, place])
        off_m = error_m(match, between(scene, (a, place), (b, place)))
        right.append(match.inliers if off_m is not None and off_m < NEAR_M else 0)
    falsely = [
        eyes.match(_any(frames[0], draws), _any(frames[1], draws)).inliers for _ in range(_OTHER)
    ]
    where = "towns " + ", ".join(map(str, CALIBRATION))
    for least in (20, 22, 24, 26, 28):
        count, wrong = (int((np.array(part) >= least).sum()) for part in (right, falsely))
        yield Row(where, f"random visits, ≥ {least} inliers", count, _SAME, wrong)


def speed_rows(eyes: Eyes, monitor: Monitor) -> Iterator[Row]:
    """What describing 600 corners adds to a frame of one core; ENGRAM_ISA chooses the instructions.

    Frames with descriptors and without alternate. Of each pair of images the least time counts:
    the thread's own clock still sees what other programs do to the caches.
    """
    scene, config = judged_scene(TOWNS[0][0], monitor), eyes.frontend.config
    added_s = []
    for place in range(scene.left.shape[1]):
        pair = scene.pair(0, place)
        times_s: tuple[list[float], list[float]] = ([], [])
        for _ in range(20):
            for times, detect in zip(times_s, (detect_corners, kind_of(eyes).detect), strict=True):
                began = time.thread_time()
                detect(pair, config, 600)
                times.append(time.thread_time() - began)
        added_s.append(min(times_s[1]) - min(times_s[0]))
    added_ms = round(1000 * float(np.mean(added_s)), 2)
    yield Row(_core.isa, "600 corners described, ms added to a frame", added_ms)


def rows_of(eyes: Eyes, monitor: Monitor) -> Iterator[Row]:
    """All figures of a kind."""
    for seeds in TOWNS:
        yield from town_rows(eyes, seeds, monitor)
    yield from calibration_rows(eyes, monitor)
    yield from speed_rows(eyes, monitor)
    if os.environ.get("ENGRAM_DATA"):
        for name in REAL:
            for one in PARTS[name](eyes):
                yield Row("real", f"{name}: {one.name.strip()}, {one.unit}", one.value)


def table(found: Mapping[str, Sequence[Row]]) -> str:
    """The kinds side by side, in Markdown."""
    names = list(found)
    lines = [
        "| " + " | ".join(["where", "what", "of", *names]) + " |",
        "|" + " --- |" * (3 + len(names)),
    ]
    for rows in zip(*found.values(), strict=True):
        cells = [f"{row.value:g}" + (f" ({row.wrong} wrong)" if row.wrong else "") for row in rows]
        first = rows[0]
        lines.append("| " + " | ".join([first.where, first.what, f"{first.of:g}", *cells]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--kinds", default="brief,net", help="joined by commas")
    parser.add_argument(
        "--second", type=int, default=3, metavar="LEVELS", help="frontend.second_threshold"
    )
    parser.add_argument("--out", type=Path, help="OUT.csv and OUT.table.md are written")
    asked = parser.parse_args()
    found: dict[str, list[Row]] = {}
    for name in asked.kinds.split(","):
        found[name] = []
        for row in rows_of(Eyes.of(name, asked.second), Bars()):
            found[name].append(row)
            print(
                name,
                row.where,
                row.what,
                f"{row.value:g} of {row.of:g}, {row.wrong} wrong",
                flush=True,
            )
    print("\n" + table(found))
    if asked.out:
        _write(asked.out, found)


def _write(out: Path, found: Mapping[str, Sequence[Row]]) -> None:
    with write_whole(out.with_suffix(".csv")) as draft, draft.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["kind", "where", "what", "value", "of", "wrong"])
        for name, rows in found.items():
            writer.writerows(
                [name, r.where, r.what, f"{r.value:g}", f"{r.of:g}", r.wrong] for r in rows
            )


if __name__ == "__main__":
    main()
