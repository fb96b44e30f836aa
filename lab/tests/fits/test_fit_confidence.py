"""What the fit of `confidence` makes of rows whose law is known."""

import math

import numpy as np
import pytest

from engram.localiser.acceptance import Spread
from engram.localiser.confidence import Evidence, Standing
from engram_lab.fits.confidence import Row, Rows, fitted, judged, judged_lookalikes, logistic

RNG = np.random.default_rng(3)


def made(count: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    terms = np.column_stack([np.ones(count), RNG.normal(size=(count, 2))])
    odds = terms @ np.array([1.0, 2.0, -0.5])
    return terms, (RNG.random(count) < 1 / (1 + np.exp(-odds))).astype(float)


def test_weights_of_a_known_law_are_found() -> None:
    assert logistic(*made(), (0, 0, 0)) == pytest.approx([1.0, 2.0, -0.5], abs=0.1)


def test_a_weight_of_the_wrong_sign_is_none() -> None:
    weights = logistic(*made(), (0, 1, 1))
    assert weights[2] == 0
    assert weights[1] > 1.5


def test_a_row_that_counts_twice_is_two_rows() -> None:
    terms, right = made(400)
    twice = logistic(np.vstack([terms, terms[:100]]), np.append(right, right[:100]), (0, 0, 0))
    counts = np.where(np.arange(400) < 100, 2.0, 1.0)
    # The scale by which the prior holds weights back is that of the rows, however often they count.
    assert logistic(terms, right, (0, 0, 0), counts) == pytest.approx(twice, abs=0.02)


def rows(count: int, kind: str, *, right: bool) -> list[Row]:
    """Matches that are read as `kind`; right ones have three times the inliers."""
    made = []
    for inliers in RNG.gamma(9.0, (80 if right else 25) / 9.0, count).astype(int) + 12:
        near, far, sigma_m, off, height = RNG.uniform(0.1, 1.0, 5)
        fixes = {"told": 0, "anywhere": 0}.get(kind, 1 + int(RNG.integers(9)))
        evidence = Evidence(
            int(inliers), inliers / 600, 8 * far, 0.3 * near,
            Standing(fixes, float(RNG.uniform(0, 2)), 60.0),
            math.inf if kind == "anywhere" else sigma_m,
            math.inf if kind == "anywhere" else 2 * off,
            None if kind == "predicted" else Spread(0.5 * near, height, 10.0),
        )  # fmt: skip
        made.append(Row(evidence, 0.1 if right else 30.0, 0.0))
    return made


def test_look_alikes_do_not_make_every_match_less_likely() -> None:
    """Ten times the wrong matches of the same kind: the weights see them, the constant does not."""
    met = []
    for kind in ("predicted", "doubted", "told", "anywhere"):
        met += rows(600, kind, right=True) + rows(200, kind, right=False)
    alike = rows(2_000, "anywhere", right=False) + rows(2_000, "told", right=False)
    plain, with_them = fitted(Rows(met, []), 35), fitted(Rows(met, alike), 35)
    found = rows(20, "anywhere", right=True) + rows(20, "told", right=True)
    for row in found:
        before = max(plain.as_anywhere(row.evidence), plain.as_predicted(row.evidence))
        after = max(with_them.as_anywhere(row.evidence), with_them.as_predicted(row.evidence))
        assert after == pytest.approx(before, abs=2.0)


def test_wrong_matches_are_counted_against_what_is_claimed() -> None:
    """Rows of which a known share is wrong, all of one claim: the report counts them."""
    kinds = ("predicted", "doubted", "told", "anywhere")
    met = [row for kind in kinds for row in rows(300, kind, right=True)]
    met += [row for kind in kinds for row in rows(100, kind, right=False)]
    known = fitted(Rows(met, []), 45)
    same = [Row(met[0].evidence, 30.0 if number < 25 else 0.1, 0.0) for number in range(500)]
    figures = {one.name: one.value for one in judged(known, same, met)}
    claimed = known.as_predicted(met[0].evidence)
    assert figures["  of them wrong"] == 25
    assert figures["  by what is claimed"] == pytest.approx(500 / (1 + math.exp(claimed)))


def test_look_alikes_are_counted_by_what_is_claimed_of_them_and_right_ones_are_not() -> None:
    kinds = ("predicted", "doubted", "told", "anywhere")
    met = [row for kind in kinds for row in rows(300, kind, right=True)]
    met += [row for kind in kinds for row in rows(100, kind, right=False)]
    known = fitted(Rows(met, []), 45)
    strong = max(met, key=lambda row: known.as_predicted(row.evidence)).evidence
    weak = min(met[-100:], key=lambda row: known.as_anywhere(row.evidence)).evidence
    assert known.as_predicted(strong) > 7
    alike = [Row(strong, 80.0, 0.0)] * 3 + [Row(weak, 80.0, 0.0)] * 2 + [Row(strong, 0.1, 0.0)] * 9
    figures = {one.name: one.value for one in judged_lookalikes(known, alike)}
    assert figures["look-alikes judged"] == 5
    assert figures["  believed where fixes lead to expect them"] == 3
    assert figures["  claimed with more than 7"] == 3
