"""Fits the weights of `engram.localiser.confidence`, and judges them on towns kept aside.

    python -m engram_lab.fits.confidence              # renders, drives, fits, judges; resumable
    python -m engram_lab.fits.confidence --shipped    # judges the weights that Engram ships

Robots drive in small towns by day and night: undisturbed, told a wrong place, carried elsewhere,
past gaps, lost, and lost in another town. Each of their matches is a row: what was known of it, and
whether it was right, within 1 m and 5°. Misplaced robots meet look-alikes too rarely to learn from,
so all of them are searched for (`WrongPlaces`) and added; the constants are corrected for their
number. A logistic model is fitted for each reading of a match, and then a calibration of
what would be claimed of the matches that robots met. On the held-out towns, without those
look-alikes, log loss is compared with that of a logistic in inliers alone, and bin by bin how many
matches are wrong with how many would be by what is claimed. With `--shipped` the calibration is
fitted, too, and printed: `--shipped --towns 301,302,303,304` made the one that ships. With
`--estates` it is also judged on streets of equal fronts, on none of which it is fitted: what is
claimed of look-alikes that a whole street is made of.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from engram.cli.screen import Bars
from engram.frontend.frame import BRIEF, DescriptorKind
from engram.localiser.acceptance import AcceptanceConfig, Spread
from engram.localiser.confidence import (
    ANYWHERE_TERMS,
    DOUBTED_TERMS,
    PREDICTED_TERMS,
    TOLD_TERMS,
    Calibration,
    ConfidenceModel,
    Evidence,
    Standing,
    confidence_of,
)
from engram.localiser.settings import METHOD_VERSION
from engram.monitor import Monitor, write_whole
from engram.robot.settings import Settings
from engram_lab.accuracy import SURE, is_false
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.studies.conditions import Conditions
from engram_lab.studies.streets import (
    AT_NIGHT,
    FITTED_TOWNS,
    HELD_OUT_TOWNS,
    LEAST_INLIERS,
    STREETS,
    Kind,
    Looked,
    Street,
    Try,
    WrongPlaces,
    drives_in,
    other_towns,
    street,
    streets,
    towns_folder,
)
from engram_lab.town.campaigns import BESIDE, MAPPED, estate
from engram_lab.town.simulating import campaign_folder

Array = NDArray[np.float64]

# Towns with drives in every condition that nothing else is fitted on, and judges.
FITTED_SMALL, HELD_OUT_SMALL = (511,), (505,)
# Tries of each kind on each street.
TRIES = {Kind.UNDISTURBED: 1, Kind.MISPLACED: 24, Kind.CARRIED: 24, Kind.GAP: 6, Kind.LOST: 6}
_FEWER = {Kind.UNDISTURBED: 1, Kind.MISPLACED: 8, Kind.CARRIED: 8, Kind.GAP: 3, Kind.LOST: 3}
# Maps and drives of small towns: the other light, rain by day and at night, a pane, snow.
_IN_SMALL_TOWNS = (
    ((0,), 2), ((0,), 4), ((2,), 3), ((2,), 9), ((2,), 10), ((0, 2), 6), ((0, 2), 10),
)  # fmt: skip
_LOST_ROUNDS = 8
# Before there is a calibration.
AS_SUMMED = Calibration(knee=0.0, slope=1.0)
# What a second match adds that agrees: two look-alikes agree more often than chance has it.
WITNESS = 1.4
# A robot that is told a wrong place is not looked for elsewhere: what it believes there counts.
_NOT_LOOKED_FOR = frozenset({Kind.MISPLACED, Kind.CARRIED})
# Strength of the prior that weights are 0, in units of standardised terms.
_RIDGE = 1.0
_BIN = 1.0
# What each weight may be, in the order of the terms.
_MATCH_SIGNS = (0, 1, 1, -1, -1)
_PREDICTED_SIGNS = (*_MATCH_SIGNS, -1, -1, -1, 1, 1, -1)
_DOUBTED_SIGNS = (*_PREDICTED_SIGNS, 1, 1)
_TOLD_SIGNS = (*_MATCH_SIGNS, -1, -1, -1, 1, 1)
_ANYWHERE_SIGNS = (*_MATCH_SIGNS, 1, 1)
# Each so many frames are matched with all wrong places.
_EVERY = 2
_LEAST_IN_BIN = 200
_POOR = 40.0
# A second match from this far on, and at most so far, can agree with a first.
_WITNESS_M = (4.0, 15.0)


@dataclass(frozen=True, slots=True)
class Row:
    """One match: its evidence, and how far off its pose was."""

    evidence: Evidence
    error_m: float
    error_rad: float

    @property
    def right(self) -> bool:
        """Whether it was right."""
        return not is_false(self.error_m, self.error_rad)

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
        if pose is None or evidence is None or evidence.inliers < LEAST_INLIERS:
            continue
        error = street.error(looked.frame, outcome.candidate.node, pose)
        if error is not None:
            yield Row(evidence, *error)


@dataclass(frozen=True, slots=True)
class Rows:
    """Matches of robots, and of places that look like where they are not.

    Attributes:
        alike: look-alikes, as lost robots would meet them, robots that were told to be there, and
            robots that were carried from there.
    """

    met: list[Row]
    alike: list[Row]


def collected(
    towns: Sequence[int],
    small: Sequence[int],
    folder: Path,
    settings: Settings,
    monitor: Monitor,
) -> Rows:
    """The rows of some towns; those that an earlier run collected are read.

    Args:
        small: towns with drives in every condition, of `engram_lab.studies.conditions`.
    """
    rows = Rows([], [])
    for seed in small:
        for mapped, number in _IN_SMALL_TOWNS:
            town = Conditions(settings, settings.frontend.landmarks, folder / "maps", mapped)
            name = f"small-{seed}-{'-'.join(map(str, mapped))}-{number}"
            live = town.drives(seed)[number]
            _collect(rows, folder / name, town.street(seed, live), _FEWER, monitor)
    for which in (STREETS, AT_NIGHT):
        for name, there in streets(towns, settings, _LOST_ROUNDS, monitor, which):
            _collect(rows, folder / name.replace("/", "-"), there, TRIES, monitor)
    for name, there in other_towns(towns, settings, _LOST_ROUNDS, monitor):
        _collect(rows, folder / name.replace("/", "-"), there, {Kind.LOST: 6}, monitor)
    return rows


def _collect(
    rows: Rows, path: Path, street: Street, tries: dict[Kind, int], monitor: Monitor
) -> None:
    """Adds the rows of one street."""

    def met() -> Iterator[Row]:
        for kind, count in tries.items():
            for one in street.tries(kind, count, seed=11):
                for looked in street.run(one, relocalises=kind not in _NOT_LOOKED_FOR):
                    yield from rows_of(street, looked)

    def look_alikes() -> Iterator[Row]:
        places = WrongPlaces(street, _EVERY)
        for frame, there in places.lost():
            near = places.expected(frame, there), places.expected(frame, there, usual)
            for found in (there, *near[0], *near[1]):
                assert found.evidence is not None
                yield Row(found.evidence, np.inf, np.pi)

    here = _kept(path.with_name(f"{path.name}-{METHOD_VERSION}.jsonl"), met, monitor)
    usual = _usual(here)
    alike = path.with_name(f"{path.name}-alike-{METHOD_VERSION}.jsonl")
    rows.met.extend(here)
    rows.alike.extend(_kept(alike, look_alikes, monitor))
    street.close()


def _usual(rows: list[Row]) -> float:
    """Usual inliers of a street's robots; in another town those of a poor session."""
    usual = [one for row in rows if (one := row.evidence.standing.usual_inliers)]
    return float(np.median(usual)) if usual else _POOR


def _kept(path: Path, make: Callable[[], Iterator[Row]], monitor: Monitor) -> list[Row]:
    if not path.exists():
        with monitor.stage(path.name, 1) as part, write_whole(path) as draft:
            draft.write_text("".join(f"{row.to_json()}\n" for row in make()), encoding="utf-8")
            part.advance()
    return [Row.of(line) for line in path.read_text(encoding="utf-8").splitlines()]


def logistic(
    terms: Array, right: Array, signs: Sequence[int], counts: Array | float = 1.0
) -> Array:
    """Weights by Newton's method; the first term is constant and not held back.

    Args:
        terms: (N, T) float64.
        right: (N,) float64, 0 or 1.
        signs: T, what each weight may be: +1, -1, or 0 for both. One that would be of the other
            sign is 0: chance in few rows must not teach that more inliers speak against a match.
        counts: (N,) how many rows each stands for.
    """
    used = np.ones(terms.shape[1], np.bool_)
    while True:
        weights = np.zeros(terms.shape[1])
        weights[used] = _newton(terms[:, used], right, counts * np.ones(len(right)))
        wrong = weights * np.array(signs) < 0
        if not wrong.any():
            return weights
        used &= ~wrong


def _newton(terms: Array, right: Array, counts: Array) -> Array:
    scale = np.maximum(terms.std(axis=0), 1e-9)
    scale[0] = 1.0
    x, weights = terms / scale, np.zeros(terms.shape[1])
    prior = np.full(len(weights), _RIDGE)
    prior[0] = 0.0
    for _ in range(50):
        claimed = 1 / (1 + np.exp(-np.clip(x @ weights, -30, 30)))
        slope = x.T @ (counts * (right - claimed)) - prior * weights
        curve = (x * (counts * claimed * (1 - claimed))[:, None]).T @ x + np.diag(prior + 1e-9)
        step = np.linalg.solve(curve, slope)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return np.asarray(weights / scale)


def log_loss(log_odds: Array, right: Array) -> float:
    """Mean of −log of the probability given to what happened."""
    return float(np.mean(np.logaddexp(0, np.where(right > 0, -log_odds, log_odds))))


# The readings of a match, by name: terms, their signs, and what one look-alike counts.
_READINGS: dict[str, tuple[Callable[[Evidence], tuple[float, ...]], tuple[int, ...], float]] = {
    "predicted": (Evidence.predicted_terms, _PREDICTED_SIGNS, 0.1),
    "doubted": (Evidence.doubted_terms, _DOUBTED_SIGNS, 1.0),
    "told": (Evidence.told_terms, _TOLD_SIGNS, 1.0),
    "anywhere": (Evidence.anywhere_terms, _ANYWHERE_SIGNS, 1.0),
}


def _readings_of(row: Row) -> Iterator[str]:
    """How a match is read."""
    found = row.evidence
    if _is_anywhere(row):
        yield "anywhere"
    if not np.isfinite(found.apart):
        return
    if found.standing.agreed:
        # Weak ones, too: strong ones are wrong too seldom to learn from.
        if found.spread is None or _is_sure(found):
            yield "predicted"
        if found.spread is not None:
            yield "doubted"
    elif found.spread is not None:
        yield "told"


def fitted(rows: Rows, weak_inliers: int) -> ConfidenceModel:
    """The weights that fit best; `weak_inliers` those with which the rows were collected."""
    weights = {}
    for name, (terms, signs, counts) in _READINGS.items():
        met, alike = (
            [row for row in some if name in _readings_of(row)] for some in (rows.met, rows.alike)
        )
        weights[name] = _weights(terms, signs, (met, alike), counts)
    return ConfidenceModel(
        **weights, witness=WITNESS, weak_inliers=weak_inliers, calibration=AS_SUMMED
    )


def _weights(
    terms: Callable[[Evidence], tuple[float, ...]],
    signs: Sequence[int],
    rows: tuple[list[Row], list[Row]],
    counts: float,
) -> tuple[float, ...]:
    """Weights of one reading; look-alikes count for their terms, not for how often wrong is."""
    met, alike = rows
    right = np.array([row.right for row in met] + [False] * len(alike), np.float64)
    share = np.array([1.0] * len(met) + [counts] * len(alike))
    every = np.array([terms(row.evidence) for row in met + alike])
    weights = logistic(every, right, signs, share)
    wrong = sum(not row.right for row in met)
    weights[0] += np.log((wrong + counts * len(alike)) / max(wrong, 1))
    return tuple(np.round(weights, 3).tolist())


def calibrated(model: ConfidenceModel, rows: Sequence[Row]) -> Calibration:
    """The calibration by which what a model claims of matches that robots met is likeliest.

    Its knee is the least sum that is believed: below it nothing changes.
    """
    knee = AcceptanceConfig().min_confidence
    sums, right = _claims(replace(model, calibration=AS_SUMMED), rows)
    believed = sums >= knee

    def loss(slope: float) -> float:
        calibration = Calibration(knee, slope)
        claimed = np.array([calibration.log_odds(one) for one in sums[believed]])
        return log_loss(claimed, right[believed])

    return Calibration(knee, round(float(minimize_scalar(loss, bounds=(0.1, 1.5)).x), 3))


def _claims(model: ConfidenceModel, rows: Sequence[Row]) -> tuple[Array, Array]:
    """(N,) float64 what is claimed of the matches that have a reading, and 1 if right, else 0."""
    readable = [row for row in rows if any(_readings_of(row))]
    claimed = [
        max(model.as_predicted(row.evidence), model.as_anywhere(row.evidence)) for row in readable
    ]
    return np.array(claimed), np.array([row.right for row in readable], np.float64)


def judged(model: ConfidenceModel, rows: Sequence[Row], fit: Sequence[Row]) -> Iterator[Figure]:
    """Log loss against a logistic in inliers alone, and reliability bin by bin.

    Wrong matches are counted: above log-odds of 7 a bin holds one or none, and true log-odds would
    tell how many matches there are rather than how many are wrong.
    """
    claimed, right = _claims(model, rows)
    readable, known = ([row for row in some if any(_readings_of(row))] for some in (rows, fit))
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
        expected = float((1 / (1 + np.exp(claimed[inside]))).sum())
        yield Figure(f"claimed {low:+.0f} to {low + _BIN:+.0f}: matches", inside.sum())
        yield Figure("  of them wrong", float((1 - right[inside]).sum()))
        yield Figure("  by what is claimed", expected)


def passing(model: ConfidenceModel, rows: Rows) -> Iterator[Figure]:
    """Matches that robots near a confirmed or a given position would accept, of those that count.

    Matches count that have the least inliers and determine the position.
    """
    limits = AcceptanceConfig()
    for name, agreed, least in (
        ("confirmed", True, limits.min_confidence),
        ("told", False, limits.min_confidence_told),
    ):
        for what, some in (
            ("right", [row for row in rows.met if row.right]),
            ("wrong", [row for row in rows.met if not row.right]),
            ("look-alikes", rows.alike),
        ):
            known = [
                row.evidence
                for row in some
                if (row.evidence.standing.agreed > 0) is agreed
                and np.isfinite(row.evidence.apart)
                and row.evidence.inliers >= LEAST_INLIERS
                and row.evidence.match_sigma_m <= limits.max_sigma_m
            ]
            passed = sum(model.as_predicted(one) >= least for one in known)
            yield Figure(f"{name}: {what} that pass, of {len(known)}", passed)


def estate_rows(towns: Sequence[int], settings: Settings, monitor: Monitor) -> list[Row]:
    """Matches of robots switched on next to a mapped ring of equal fronts: all are wrong."""
    rows: list[Row] = []
    for seed in towns:
        town = estate(seed)
        drives = drives_in(town, settings, [MAPPED, BESIDE[0]], monitor)
        there = street(town, [MAPPED], drives, drives[BESIDE[0]], settings, _LOST_ROUNDS)
        path = campaign_folder(towns_folder(settings), town) / f"map{MAPPED}-{METHOD_VERSION}"

        def met(there: Street = there) -> Iterator[Row]:
            for looked in there.run(Try(Kind.COLD)):
                yield from rows_of(there, looked)

        rows += _kept(path.with_name(f"{path.name}-beside.jsonl"), met, monitor)
        there.close()
    return rows


def judged_lookalikes(model: ConfidenceModel, rows: Sequence[Row]) -> Iterator[Figure]:
    """What is claimed of look-alikes: how many matches, how many would be fixes, how many sure."""
    claimed, right = _claims(model, [row for row in rows if not row.right])
    yield Figure("look-alikes judged", len(right))
    for name, least in (
        ("believed where fixes lead to expect them", AcceptanceConfig().min_confidence),
        ("claimed with more than 7", SURE),
    ):
        yield Figure(f"  {name}", int((claimed > least).sum()))


def _is_anywhere(row: Row) -> bool:
    near = row.evidence.distance_m <= AcceptanceConfig().reach_m
    return near and row.evidence.spread is not None and not _is_sure(row.evidence)


def _is_sure(found: Evidence) -> bool:
    """Whether the match agrees with a position that fixes confirmed and none contradicts."""
    standing = found.standing
    confirmed = standing.agreed > 0 and standing.missed < AcceptanceConfig().doubt_after
    return confirmed and bool(np.isfinite(found.apart))


def _inliers(rows: Sequence[Row]) -> Array:
    return np.array([[1.0, np.log(row.evidence.inliers / 20.0)] for row in rows])


def text_of(model: ConfidenceModel) -> str:
    """The weights as they stand in `engram.localiser.confidence`."""
    lines = [f"    # {', '.join(PREDICTED_TERMS)}", f"    predicted={model.predicted},"]
    lines += [f"    # {', '.join(DOUBTED_TERMS)}", f"    doubted={model.doubted},"]
    lines += [f"    # {', '.join(TOLD_TERMS)}", f"    told={model.told},"]
    lines += [f"    # {', '.join(ANYWHERE_TERMS)}", f"    anywhere={model.anywhere},"]
    lines += [f"    witness={model.witness},", f"    weak_inliers={model.weak_inliers},"]
    lines += [f"    calibration={model.calibration},"]
    return "\n".join(["ConfidenceModel(", *lines, ")"])


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--kind", type=DescriptorKind, default=BRIEF, help="of features")
    parser.add_argument("--towns", type=numbers, default=list(FITTED_TOWNS))
    parser.add_argument("--held-out", type=numbers, default=list(HELD_OUT_TOWNS))
    parser.add_argument("--small", type=numbers, default=list(FITTED_SMALL))
    parser.add_argument("--held-out-small", type=numbers, default=list(HELD_OUT_SMALL))
    parser.add_argument("--estates", type=numbers, default=[], help="towns of equal fronts")
    parser.add_argument("--shipped", action="store_true", help="judge the weights that are shipped")
    asked = parser.parse_args()
    settings = Settings().for_descriptor(asked.kind)
    folder = towns_folder(settings) / "confidence"
    folder.mkdir(parents=True, exist_ok=True)
    rows = collected(asked.towns, asked.small, folder, settings, Bars())
    model = confidence_of(asked.kind)
    if not asked.shipped:
        model = fitted(rows, model.weak_inliers)
        model = replace(model, calibration=calibrated(model, rows.met))
        print(text_of(model))
    else:
        print(f"{calibrated(model, rows.met)} would fit these weights")
    report(passing(model, rows), None, "confidence, fitted towns")
    held_out = collected(asked.held_out, asked.held_out_small, folder, settings, Bars())
    report(judged(model, held_out.met, rows.met), asked.json, "confidence, held-out towns")
    if asked.estates:
        alike = estate_rows(asked.estates, settings, Bars())
        report(judged_lookalikes(model, alike), asked.json, "confidence, streets of equal fronts")


if __name__ == "__main__":
    main()
