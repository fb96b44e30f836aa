"""A corridor walked twice, with doors that all look alike: places, then an epipolar check."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from engram import _core
from engram.frontend.frame import BRIEF
from engram.places.recognisers import FabMap
from engram.places.vocabulary import default_vocabulary

pytestmark = pytest.mark.data

SECOND_LAP = 41  # first image of it, counted from 1
LANDMARKS = 600
# Chance agreement with some fundamental matrix stays below this among up to 150 matches.
LEAST_INLIERS = 20


def features(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (N, 2) and BRIEF descriptors (N, 32) as the front-end takes them."""
    positions, scores, _ = _core.detect_corners(image, 10)
    order = _core.order_corners(positions, scores, image.shape[1], image.shape[0], 32)
    positions = np.ascontiguousarray(positions[order[:LANDMARKS]])
    return positions, _core.describe(_core.smooth(image), positions)


def inliers(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> int:
    """Matches, mutual and distinct, that agree with one fundamental matrix."""
    if min(len(a[1]), len(b[1])) < 8:  # some images show nothing but a white wall
        return 0
    distances = _core.hamming_matrix(a[1], b[1]).astype(int)
    nearest = distances.argmin(axis=1)
    two = np.partition(distances, 1, axis=1)[:, :2]
    mutual = distances.argmin(axis=0)[nearest] == np.arange(len(nearest))
    good = np.flatnonzero(mutual & (two[:, 0] < 0.8 * two[:, 1]))
    if len(good) < 8:
        return 0
    cv2.setRNGSeed(1)
    _, mask = cv2.findFundamentalMat(
        a[0][good].astype(float), b[0][nearest[good]].astype(float), cv2.FM_RANSAC, 1.5, 0.999
    )
    return 0 if mask is None else int(mask.sum())


@pytest.fixture(scope="module")
def corridor(data_dir: Path) -> tuple[list[tuple[np.ndarray, np.ndarray]], dict[int, list[int]]]:
    """Features of all images, and the rows of the second lap: image → images of the first."""
    folder = data_dir / "places" / "corridor_two_laps"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    files = sorted((folder / "images").glob("*.jpg"))
    images = [features(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)) for file in files]
    rows: dict[int, list[int]] = {}
    with (folder / "loops_estimated.csv").open() as table:
        for row in csv.DictReader(table):
            if int(row["later"]) >= SECOND_LAP:
                rows.setdefault(int(row["later"]), []).append(int(row["earlier"]))
    # The walk ends where the second lap began: what a row says of that, its row says of the first.
    in_first_lap = {
        later: [n for e in earlier for n in (rows[e] if e >= SECOND_LAP else [e])]
        for later, earlier in rows.items()
    }
    return images, in_first_lap


def test_the_second_lap_is_recognised_and_no_wrong_door_is_believed(corridor) -> None:
    images, rows = corridor
    vocabulary = default_vocabulary(BRIEF)
    recogniser = FabMap(vocabulary)
    for _, descriptors in images[: SECOND_LAP - 1]:
        recogniser.add(vocabulary.words_of(descriptors, BRIEF))
    along = sorted(rows)
    right, first, wrong, answers = 0, 0, [], 0
    for number in range(SECOND_LAP, len(images) + 1):
        live = images[number - 1]
        words = vocabulary.words_of(live[1], BRIEF)
        places = recogniser.recognise(words, 10).places
        support = [inliers(live, images[place]) for place in places]
        best = int(places[int(np.argmax(support))]) + 1
        if number in rows:
            first += any(abs(int(places[0]) + 1 - true) <= 2 for true in rows[number])
        if max(support) < LEAST_INLIERS:
            continue
        answers += 1
        if number in rows:
            right += any(abs(best - true) <= 2 for true in rows[number])
        expected = np.interp(number, along, [np.mean(rows[n]) for n in along])
        if abs(best - expected) > 5:
            wrong.append((number, best, float(expected)))
    print(f"{right} of {len(rows)} right, {first} before checking, {answers} answers, {wrong}")
    # The project's aim.
    assert right >= 0.85 * len(rows)
    assert wrong == []
