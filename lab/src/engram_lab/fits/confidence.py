"""Fits the weights of `engram.localiser.confidence`, and judges them on towns kept aside.

    python -m engram_lab.fits.confidence              # renders, drives, fits, judges; resumable

Robots drive in small towns: undisturbed, told a wrong place, carried elsewhere, past gaps, lost,
and lost in another town. Each of their matches is a row: what was known of it, and whether it was
right, within 1 m and 5°. Two logistic models are fitted, one for each reading of a match. On the
held-out towns their log loss is compared with that of a logistic in inliers alone, and claimed with
true log-odds bin by bin.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.cli.progress import Bars
from engram.localiser import METHOD_VERSION, AcceptanceConfig, Spread
from engram.localiser.confidence import (
    ANYWHERE_TERMS,
    PREDICTED_TERMS,
    ConfidenceModel,
    Evidence,
    Standing,
)
from engram.monitor import Monitor, write_whole
from engram.robot import Settings
from engram_lab.misplaced import FALSE_M, FALSE_RAD, Kind, Looked, Street
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.town.simulating import campaigns_folder
from engram_lab.trial_towns import (
    BY_NIGHT,
    FITTED_TOWNS,
    HELD_OUT_TOWNS,
    STREETS,
    other_towns,
    streets,
)

Array = NDArray[np.float64]

# Tries of each kind on each street.
TRIES = {Kind.UNDISTURBED: 1, Kind.TOLD: 24, Kind.CARRIED: 24, Kind.GAP: 6, Kind.LOST: 6}
_LOST_ROUNDS = 8
# A robot that is told a wrong place is not looked for elsewhere: what it believes there counts.
_NOT_LOOKED_FOR = frozenset({Kind.TOLD, Kind.CARRIED})
_LEAST_INLIERS = 12
# Strength of the prior that weights are 0, in units of standardised terms.
_RIDGE = 1.0
_BIN = 1.0
# What each weight may be, in the order of the terms.
_MATCH_SIGNS = (0, 1, 1, -1, 1, -1, -1)
_PREDICTED_SIGNS = (*_MATCH_SIGNS, 1, -1, -1, -1)
_ANYWHERE_SIGNS = (*_MATCH_SIGNS, 1, 1)
_LEAST_IN_BIN = 200
# A second match from this far on, and at most so far, can agree with a first.
_WITNESS_M = (4.0, 15.0)


@dataclass(frozen=True, slots=True)
class Row:
    """One match: what was known, and how far off its pose was."""

    evidence: Evidence
    error_m: float
    error_rad: float

    @property
    def right(self) -> bool:
        """Whether it was right."""
        return self.error_m <= FALSE_M and self.error_rad <= FALSE_RAD

    def to_json(self) -> str:
        """A line of text."""
        return json.dumps([astuple(self.evidence), self.error_m, self.error_rad])

    @staticmethod
    def of(line: str) -> Row:
        """The row of such a line."""
        (inliers, share, far, sigma, standing, expected, apart, spread), *error = json.loads(line)
        return Row(
            Evidence(
                inliers, share, far, sigma, Standing(*standing), expected, apart,
                None if spread is None else Spread(*spread),
            ),
            *error,
        )  # fmt: skip


def rows_of(street: Street, looked: Looked) -> Iterator[Row]:
    """The matches of one frame."""
    for outcome in looked.outcomes:
        pose, evidence = outcome.match.reference_from_live, outcome.evidence
        if pose is None or evidence is None or evidence.inliers < _LEAST_INLIERS:
            continue
        error = street.error(looked.frame, outcome.candidate.node, pose)
        if error is not None:
            yield Row(evidence, *error)


def collected(towns: Sequence[int], folder: Path, monitor: Monitor) -> list[Row]:
    """The rows of some towns; those that an earlier run collected are read."""
    rows: list[Row] = []
    for which in (STREETS, BY_NIGHT):
        for name, street in streets(towns, Settings(), _LOST_ROUNDS, monitor, which):
            rows += _kept(folder, name, street, TRIES, monitor)
    for name, street in other_towns(towns, Settings(), _LOST_ROUNDS, monitor):
        rows += _kept(folder, name, street, {Kind.LOST: 6}, monitor)
    return rows


def _kept(
    folder: Path, name: str, street: Street, tries: dict[Kind, int], monitor: Monitor
) -> list[Row]:
    path = folder / f"{name.replace('/', '-')}-{METHOD_VERSION}.jsonl"
    if not path.exists():
        with monitor.stage(name, sum(tries.values())) as part:
            rows = []
            for kind, count in tries.items():
                for one in street.tries(kind, count, seed=11):
                    run = street.run(one, relocalises=kind not in _NOT_LOOKED_FOR)
                    rows += [row for looked in run for row in rows_of(street, looked)]
                    part.advance()
        with write_whole(path) as draft:
            draft.write_text("".join(f"{row.to_json()}\n" for row in rows), encoding="utf-8")
    street.close()
    return [Row.of(line) for line in path.read_text(encoding="utf-8").splitlines()]


def logistic(terms: Array, right: Array, signs: Sequence[int], ridge: float = _RIDGE) -> Array:
    """Weights by Newton's method; the first term is constant and not held back.

    Args:
        terms: (N, T) float64.
        right: (N,) float64, 0 or 1.
        signs: T, what each weight may be: +1, -1, or 0 for both. One that would be of the other
            sign is 0: chance in few rows must not teach that more inliers speak against a match.
        ridge: strength of the prior.
    """
    used = np.ones(terms.shape[1], np.bool_)
    while True:
        weights = np.zeros(terms.shape[1])
        weights[used] = _newton(terms[:, used], right, ridge)
        wrong = weights * np.array(signs) < 0
        if not wrong.any():
            return weights
        used &= ~wrong


def _newton(terms: Array, right: Array, ridge: float) -> Array:
    scale = np.maximum(terms.std(axis=0), 1e-9)
    scale[0] = 1.0
    x, weights = terms / scale, np.zeros(terms.shape[1])
    prior = np.full(len(weights), ridge)
    prior[0] = 0.0
    for _ in range(50):
        claimed = 1 / (1 + np.exp(-np.clip(x @ weights, -30, 30)))
        slope = x.T @ (right - claimed) - prior * weights
        curve = (x * (claimed * (1 - claimed))[:, None]).T @ x + np.diag(prior + 1e-9)
        step = np.linalg.solve(curve, slope)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return np.asarray(weights / scale)


def log_loss(log_odds: Array, right: Array) -> float:
    """Mean of −log of the probability given to what happened."""
    return float(np.mean(np.logaddexp(0, np.where(right > 0, -log_odds, log_odds))))


def readings(rows: Sequence[Row]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Terms and truth of the rows that a prediction expects, and of those of lost robots."""
    expected = [row for row in rows if np.isfinite(row.evidence.apart)]
    anywhere = [row for row in rows if _is_anywhere(row)]
    return (
        _of([row.evidence.predicted_terms() for row in expected], expected),
        _of([row.evidence.anywhere_terms() for row in anywhere], anywhere),
    )


def _of(terms: list[tuple[float, ...]], rows: list[Row]) -> tuple[Array, Array]:
    return np.array(terms), np.array([row.right for row in rows], np.float64)


def fitted(rows: Sequence[Row]) -> ConfidenceModel:
    """The weights that fit best."""
    expected, anywhere = readings(rows)
    return ConfidenceModel(
        tuple(np.round(logistic(*expected, _PREDICTED_SIGNS), 3).tolist()),
        tuple(np.round(logistic(*anywhere, _ANYWHERE_SIGNS), 3).tolist()),
        witness=4.0,
    )


def judged(model: ConfidenceModel, rows: Sequence[Row], fit: Sequence[Row]) -> Iterator[Figure]:
    """Log loss against a logistic in inliers alone, and reliability bin by bin."""
    readable = [row for row in rows if _has_reading(row)]
    right = np.array([row.right for row in readable], np.float64)
    claimed = np.array(
        [max(model.as_predicted(r.evidence), model.as_anywhere(r.evidence)) for r in readable]
    )
    known = [row for row in fit if _has_reading(row)]
    truth = np.array([row.right for row in known], np.float64)
    plain = logistic(_inliers(known), truth, (0, 0))
    alone, ours = log_loss(_inliers(readable) @ plain, right), log_loss(claimed, right)
    yield Figure("matches judged", len(readable))
    yield Figure("  of them right", 100 * float(right.mean()), "%")
    yield Figure("log loss", ours)
    yield Figure("log loss of inliers alone", alone)
    yield Figure("ratio", ours / alone)
    edges = np.arange(-8.0, 12.0, _BIN)
    for low in edges:
        inside = (claimed >= low) & (claimed < low + _BIN)
        if inside.sum() < _LEAST_IN_BIN:
            continue
        hits, count = right[inside].sum(), inside.sum()
        actual = np.log((hits + 0.5) / (count - hits + 0.5))
        yield Figure(f"claimed {low:+.0f} to {low + _BIN:+.0f} ({count}): true log-odds", actual)


def _has_reading(row: Row) -> bool:
    return bool(np.isfinite(row.evidence.apart)) or _is_anywhere(row)


def _is_anywhere(row: Row) -> bool:
    near = row.evidence.distance_m <= AcceptanceConfig().reach_m
    return near and row.evidence.spread is not None


def _inliers(rows: Sequence[Row]) -> Array:
    return np.array([[1.0, np.log(row.evidence.inliers / 20.0)] for row in rows])


def text_of(model: ConfidenceModel) -> str:
    """The weights as they stand in `engram.localiser.confidence`."""
    lines = [f"    # {', '.join(PREDICTED_TERMS)}", f"    predicted={model.predicted},"]
    lines += [f"    # {', '.join(ANYWHERE_TERMS)}", f"    anywhere={model.anywhere},"]
    return "\n".join(["ConfidenceModel(", *lines, f"    witness={model.witness},", ")"])


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(FITTED_TOWNS))
    parser.add_argument("--held-out", type=numbers, default=list(HELD_OUT_TOWNS))
    parser.add_argument("--out", type=Path, default=campaigns_folder() / "confidence")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    rows = collected(asked.towns, asked.out, Bars())
    model = fitted(rows)
    print(text_of(model))
    held_out = collected(asked.held_out, asked.out, Bars())
    report(judged(model, held_out, rows), asked.json, "confidence, held-out towns")


if __name__ == "__main__":
    main()
