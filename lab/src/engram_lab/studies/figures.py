"""[L15] Figs. 9 to 13 on our data, and what the paper has no figure for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.viewing import Line, Panel, draw_bars, draw_curves
from engram_lab.intervals import FORMULAS, Estimator, Interval, SessionSums, Statistic, difference
from engram_lab.studies.configurations import (
    T_SWEEP,
    UNLIMITED,
    Configuration,
    PathKinds,
    lanes_text,
)
from engram_lab.studies.summary import CURVE_AT_M, CampaignResult, ConfigurationResult
from engram_lab.studies.sweeps import by_lanes, by_map_size

_P_GT_10M = "P(no match for > 10 m), %"
_NOT_LOCALISED = "route not localised, %"
# Unlimited lanes stand one step behind the last number.
_BEYOND = 20.0
# A policy has one colour in all figures, whichever others are drawn beside it.
POLICY_COLOURS = {
    "distance": "C0",
    "path-near": "C1",
    "path": "C2",
    "random": "C3",
    "oracle": "C4",
    "time-of-day": "C5",
    "bag-of-words": "C6",
    "collaborative": "C7",
    "nearest-of-each": "C8",
    "bandit": "C9",
    "recall": "black",
}
_LOOKS = {policy: (colour, "-") for policy, colour in POLICY_COLOURS.items()} | {
    Configuration("path-near", paths=PathKinds.MATCHED).label: (POLICY_COLOURS["path-near"], "--")
}


def draw_figures(out: Path, campaigns: Sequence[CampaignResult]) -> list[Path]:
    """Draws every figure for which results are there; returns the files.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    written: list[Path] = []

    def draw(name: str, panels: Iterable[Panel | None], title: str) -> None:
        shown = [panel for panel in panels if panel is not None and panel.lines]
        if shown:
            draw_curves(shown, out / name, title, _LOOKS)
            written.append(out / name)

    few = ", ".join(sorted(set(map(_budget, campaigns))))
    rounds = ", ".join(sorted({f"Nr = {one.rounds}" for one in campaigns}))
    np_title = f"failure against the number of lanes, {rounds}, T = 10"
    draw("fig09_map_size.png", map(_map_size, campaigns), f"failure as the map grows, {few}")
    draw("fig10_candidates.png", map(_candidates, campaigns), "candidates along an ordinary lap")
    draw("fig11_lanes.png", [_lanes(one, _p_gt_10m) for one in campaigns], np_title)
    draw(
        "fig11_lanes_not_localised.png",
        [_lanes(one, _missed, _NOT_LOCALISED) for one in campaigns],
        np_title,
    )
    draw("fig11_lanes_against_distance.png", map(_against_distance, campaigns), np_title)
    for estimator in Estimator:
        draw(
            f"fig12_curves_{estimator.value}.png",
            [_curves(one, twice, estimator) for twice in (1, 2) for one in campaigns],
            f"failure curves, {rounds}; P(X ≥ x) = {FORMULAS[estimator]}",
        )
    draw(
        "fig12_curves_lost_scaled.png",
        [_curves(one, twice, Estimator.LOST, scaled=True) for twice in (1, 2) for one in campaigns],
        f"failure curves, {rounds}; {FORMULAS[Estimator.LOST]} · share of route not localised",
    )
    draw("fig13_T.png", map(_sensitivity, campaigns), f"sensitivity of path to T, {few}")
    for campaign in campaigns:
        written += _draw_costs(out, campaign)
    return written


def _budget(campaign: CampaignResult) -> str:
    return f"Np = {lanes_text(campaign.few_lanes)}, Nr = {campaign.rounds}"


def _p_gt_10m(result: ConfigurationResult) -> SessionSums:
    return result.failure(10.0)


def _missed(result: ConfigurationResult) -> SessionSums:
    return result.not_localised


def _map_size(campaign: CampaignResult) -> Panel | None:
    """[L15] Fig. 9: P(> 10 m) against nodes, after each training session."""
    lines = []
    for policy in campaign.policies:
        results = by_map_size(campaign, policy)
        if len(results) > 1:
            nodes = np.array([np.mean([s.nodes for s in one.sessions]) for one in results])
            lines.append(_line(campaign, policy, nodes, map(_p_gt_10m, results)))
    # The first map, of one drive, misses ten times as much as the next.
    label = "nodes in the map"
    return Panel(campaign.name, label, _P_GT_10M, lines, least_y=0.1) if lines else None


def _candidates(campaign: CampaignResult) -> Panel | None:
    """[L15] Fig. 10: |Y| and how many of it could succeed, along one lap."""
    lap = campaign.lap
    if lap is None:
        return None
    lines = [
        Line("candidates |Y|", lap.driven_m, lap.candidates.astype(np.float64), marks=False),
        Line("that match", lap.driven_m, lap.succeeded.astype(np.float64), marks=False),
    ]
    return Panel(f"{campaign.name}, {lap.name}", "driven, m", "nodes", lines)


def _lanes(
    campaign: CampaignResult,
    measure: Callable[[ConfigurationResult], SessionSums],
    y_label: str = _P_GT_10M,
) -> Panel | None:
    """[L15] Fig. 11: failure against Np."""
    lines = []
    variants = [(policy, PathKinds.ALL) for policy in campaign.policies]
    for policy, paths in [*variants, ("path-near", PathKinds.MATCHED)]:
        results = by_lanes(campaign, policy, paths)
        if len(results) > 1:
            label = results[0].configuration.label
            lines.append(_lanes_line(campaign, label, results, map(measure, results)))
    return _lanes_panel(campaign, y_label, lines)


def _against_distance(campaign: CampaignResult) -> Panel | None:
    """Paired: what makes a session hard for all drops out."""
    nearest = {one.configuration.lanes: one for one in by_lanes(campaign, "distance")}
    lines = []
    for policy in campaign.policies:
        results = [one for one in by_lanes(campaign, policy) if one.configuration.lanes in nearest]
        if len(results) > 1:
            gaps = (
                difference(one.not_localised, nearest[one.configuration.lanes].not_localised)
                for one in results
            )
            lines.append(_lanes_line(campaign, policy, results, gaps))
    label = "route not localised less distance's, points"
    return _lanes_panel(campaign, label, lines, signed=True)


def _lanes_line(
    campaign: CampaignResult,
    label: str,
    results: Sequence[ConfigurationResult],
    statistics: Iterable[Statistic],
) -> Line:
    x = np.array([_lanes_place(one.configuration.lanes) for one in results])
    line = _line(campaign, label, x, statistics)
    return replace(line, loose_end=bool(x[-1] == _BEYOND))


def _lanes_panel(
    campaign: CampaignResult, y_label: str, lines: Sequence[Line], *, signed: bool = False
) -> Panel | None:
    places = sorted({float(x) for line in lines for x in line.x})
    ticks = [(x, "∞" if x == _BEYOND else f"{x:.0f}") for x in places]
    return Panel(campaign.name, "Np", y_label, lines, ticks, signed=signed) if lines else None


def _lanes_place(lanes: int) -> float:
    return _BEYOND if lanes == UNLIMITED else float(lanes)


def _curves(
    campaign: CampaignResult, twice: int, estimator: Estimator, *, scaled: bool = False
) -> Panel | None:
    """[L15] Fig. 12: P(X ≥ x), under the few lanes or twice as many."""
    lines, lanes = [], twice * campaign.few_lanes
    for policy in campaign.policies:
        result = campaign.get(policy, lanes)
        if result is not None:
            bands = result.curve(campaign.resamples, estimator, scaled=scaled)
            y, low, high = (100 * band for band in bands)
            lines.append(Line(policy, CURVE_AT_M, y, low, high, marks=False))
    title = f"{campaign.name}, Np = {lanes_text(lanes)}"
    return Panel(title, "x, m", "P(X ≥ x), %", lines, least_y=0.01) if lines else None


def _sensitivity(campaign: CampaignResult) -> Panel | None:
    """[L15] Fig. 13: T."""
    results = [campaign.get("path-near", T=T) for T in T_SWEEP]
    found = [one for one in results if one is not None]
    if len(found) < 2:
        return None
    places = np.arange(len(found), dtype=np.float64)
    ticks = [(float(x), str(one.configuration.T)) for x, one in zip(places, found, strict=True)]
    lines = [
        _line(campaign, "P(> 10 m)", places, map(_p_gt_10m, found)),
        _line(campaign, "route not localised", places, map(_missed, found)),
    ]
    return Panel(campaign.name, "T", "%", lines, ticks)


def _line(
    campaign: CampaignResult,
    label: str,
    x: NDArray[np.float64],
    statistics: Iterable[Statistic],
) -> Line:
    """In per cent, with a 90 % band over sessions."""
    bands: list[Interval] = [campaign.resamples.interval(one) for one in statistics]
    columns = [[getattr(band, name) for band in bands] for name in ("estimate", "low", "high")]
    y, low, high = (100 * np.array(column) for column in columns)
    return Line(label, x, y, low, high)


def _draw_costs(out: Path, campaign: CampaignResult) -> list[Path]:
    """Attempts, time, false successes and pose errors of all policies at the few lanes."""
    memo = {policy: campaign.get(policy) for policy in campaign.policies}
    found = {policy: one for policy, one in memo.items() if one is not None}
    timed = {one.policy: result.step_ms for one, result in campaign.live.items()}
    bars: list[tuple[str, list[tuple[str, float]]]] = [
        ("attempts per frame", [(p, one.attempts_per_frame) for p, one in found.items()])
    ]
    if timed:
        in_order = [(policy, timed[policy]) for policy in found if policy in timed]
        bars.append(("ms per frame (guided, no memo)", in_order))
    if campaign.with_truth:
        bars.append(
            (
                "false successes, % of successes",
                [(p, 100 * (r.false_share or 0.0)) for p, r in found.items()],
            )
        )
        bars.append(
            (
                "median error, cm",
                [
                    (p, 100 * float(np.median(r.errors.offset_m)))
                    for p, r in found.items()
                    if len(r.errors.offset_m)
                ],
            )
        )
    if not found:
        return []
    path = out / f"costs_{campaign.name}.png"
    title = f"{campaign.name}, {_budget(campaign)}"
    draw_bars(bars, path, title)
    return [path]
